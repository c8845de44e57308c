/* Checks that errors are reported and have no other effect: each line of output is a call that has to fail, and its error. */
#include "conicflow.h"

#include <math.h>
#include <stdio.h>

static const conicflow_camera GOOD = {4, 3, 5.0, 5.0, 1.5, 1.0};

static void told(const char *call, int failed) {
    printf("%s: %s: %s\n", call, failed ? "refused" : "TAKEN", conicflow_error());
}

static void create(const char *call, const conicflow_camera *camera, double scale, const char *noise) {
    conicflow_detector *detector = conicflow_create(camera, scale, noise);
    told(call, detector == NULL);
    conicflow_free(detector);
}

int main(void) {
    static const uint16_t depth[4 * 3 + 1] = {0};
    static const float metres[4 * 3] = {0};
    const conicflow_object *objects = NULL;
    conicflow_camera none = GOOD, huge = GOOD, blind = GOOD;
    none.width = 0;
    huge.width = huge.height = UINT32_MAX;
    blind.fx = NAN;
    printf("at first: %s\n", conicflow_error());
    create("no camera", NULL, 0.001, NULL);
    create("no pixels", &none, 0.001, NULL);
    create("too many pixels", &huge, 0.001, NULL);
    create("no focal length", &blind, 0.001, NULL);
    create("no scale", &GOOD, 0.0, NULL);
    create("no such sensor", &GOOD, 0.001, "kinect");
    create("no text", &GOOD, 0.001, "\xff\xfe");

    conicflow_detector *detector = conicflow_create(&GOOD, 0.001, NULL);
    told("no detector", conicflow_detect(NULL, depth, 0, &objects) == -1);
    told("no image", conicflow_detect(detector, NULL, 0, &objects) == -1);
    told("no place", conicflow_detect(detector, depth, 0, NULL) == -1);
    told("short rows", conicflow_detect(detector, depth, 6, &objects) == -1);
    told("half a pixel", conicflow_detect(detector, depth, 9, &objects) == -1);
    told("no such memory", conicflow_detect_metres(detector, metres, SIZE_MAX - 3, &objects) == -1);
    told("odd address", conicflow_detect(detector, (const uint16_t *)((const char *)depth + 1), 0, &objects) == -1);
    objects = (const conicflow_object *)depth;
    printf("an empty image: %d\n", conicflow_detect(detector, depth, 0, &objects));
    printf("its objects: %s\n", objects ? "something" : "NULL");
    conicflow_free(detector);
    conicflow_free(NULL);
    return 0;
}
