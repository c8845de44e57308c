/*
 * Prints the spheres, cylinders and cones of a depth image: a 16-bit PGM, in millimetres, as OpenCV, GIMP and netpbm write it.
 *
 *     cargo build --release -p conicflow-c
 *     cc c/example.c -I c target/release/libconicflow.a -lm -lpthread -ldl -o example
 *     ./example frame.pgm 525 525 319.5 239.5
 */
#include "conicflow.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>

/* Reads the next number in the header of a PGM, skipping lines that begin with #; returns 0 if there is none. */
static unsigned read_number(FILE *file) {
    unsigned number = 0;
    while (fscanf(file, " %u", &number) != 1 && fgetc(file) == '#') {
        for (int c = 0; c != '\n' && c != EOF;) c = fgetc(file);
    }
    return number;
}

/* Reads the pixels of a PGM, which are big-endian; returns NULL if the file is no PGM. */
static uint16_t *read_pgm(const char *path, conicflow_camera *camera) {
    FILE *file = fopen(path, "rb");
    uint16_t *depth = NULL;
    if (file && fgetc(file) == 'P' && fgetc(file) == '5') {
        camera->width = read_number(file);
        camera->height = read_number(file);
    }
    if (file && camera->width && camera->height && read_number(file) == 65535) {
        size_t pixels = (size_t)camera->width * camera->height;
        unsigned char *bytes = calloc(pixels, 2);
        depth = calloc(pixels, sizeof *depth);
        fgetc(file);
        if (bytes && depth && fread(bytes, 2, pixels, file) == pixels) {
            for (size_t i = 0; i < pixels; i++) depth[i] = (uint16_t)(bytes[2 * i] << 8 | bytes[2 * i + 1]);
        } else {
            free(depth);
            depth = NULL;
        }
        free(bytes);
    }
    if (file) fclose(file);
    return depth;
}

int main(int argc, char **argv) {
    static const char *const names[] = {"sphere", "cylinder", "cone"};
    conicflow_camera camera = {0};
    if (argc != 6) {
        fprintf(stderr, "usage: example FILE.pgm FX FY CX CY\n");
        return 2;
    }
    camera.fx = atof(argv[2]);
    camera.fy = atof(argv[3]);
    camera.cx = atof(argv[4]);
    camera.cy = atof(argv[5]);
    uint16_t *depth = read_pgm(argv[1], &camera);
    if (!depth) {
        fprintf(stderr, "%s is no 16-bit PGM\n", argv[1]);
        return 1;
    }

    const conicflow_object *objects;
    conicflow_detector *detector = conicflow_create(&camera, 0.001, "kinect_v1");
    int count = detector ? conicflow_detect(detector, depth, 0, &objects) : -1;
    if (count < 0) fprintf(stderr, "error: %s\n", conicflow_error());
    for (int i = 0; i < count; i++) {
        const conicflow_object *o = &objects[i];
        printf("%s at (%.3f, %.3f, %.3f) m, radius %.4f m +- %.4f, depth +- %.4f, confidence %.2f\n", names[o->kind],
               o->center[0], o->center[1], o->center[2], o->radius, o->sigma.radius,
               sqrt(o->sigma.center_covariance[2][2]), o->confidence);
    }
    conicflow_free(detector);
    free(depth);
    return count < 0 ? 1 : 0;
}
