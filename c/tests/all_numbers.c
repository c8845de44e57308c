/* Writes the bytes of all objects in an image, for the library's test. */
#include "conicflow.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static void *read_all(const char *path, size_t *bytes) {
    FILE *file = fopen(path, "rb");
    if (!file || fseek(file, 0, SEEK_END) != 0) exit(3);
    *bytes = (size_t)ftell(file);
    rewind(file);
    void *memory = malloc(*bytes);
    if (!memory || fread(memory, 1, *bytes, file) != *bytes) exit(3);
    fclose(file);
    return memory;
}

/* all_numbers u16|f32 FILE WIDTH HEIGHT FX FY CX CY ROW_BYTES SCALE NOISE: FILE holds the pixels as in memory. */
int main(int argc, char **argv) {
    if (argc != 12) return 3;
    conicflow_camera camera = {(uint32_t)atoi(argv[3]), (uint32_t)atoi(argv[4]), atof(argv[5]), atof(argv[6]), atof(argv[7]), atof(argv[8])};
    size_t bytes, row_bytes = strtoul(argv[9], NULL, 10);
    void *depth = read_all(argv[2], &bytes);
    conicflow_detector *detector = conicflow_create(&camera, atof(argv[10]), argv[11]);
    const conicflow_object *objects = NULL;
    /* Twice, so that data left over from the first image would show in the second. */
    for (int round = 0; round < 2; round++) {
        int count = strcmp(argv[1], "u16") == 0 ? conicflow_detect(detector, depth, row_bytes, &objects)
                                                : conicflow_detect_metres(detector, depth, row_bytes, &objects);
        if (count < 0) {
            fprintf(stderr, "%s\n", conicflow_error());
            conicflow_free(detector);
            free(depth);
            return 1;
        }
        fwrite(objects, sizeof *objects, (size_t)count, stdout);
    }
    conicflow_free(detector);
    free(depth);
    return 0;
}
