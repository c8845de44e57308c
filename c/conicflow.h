/*
 * conicflow.h: spheres, cylinders and cones in the images of a depth camera.
 *
 *     conicflow_camera camera = {640, 480, 525.0, 525.0, 319.5, 239.5};
 *     conicflow_detector *detector = conicflow_create(&camera, 0.001, "kinect_v1");
 *     const conicflow_object *objects;
 *     int count = detector ? conicflow_detect(detector, depth, 0, &objects) : -1;
 *     if (count < 0) fprintf(stderr, "%s\n", conicflow_error());
 *     conicflow_free(detector);
 *
 * Units are SI: metres, radians. The camera frame is the optical frame: x right, y down, z forward.
 * Each thread may have its own detector; a detector must be used by one thread at a time.
 */
#ifndef CONICFLOW_H
#define CONICFLOW_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* The version of this header; that of the library is conicflow_version(). */
#define CONICFLOW_VERSION "0.1.0"

/* A pinhole camera without distortion: a pixel (u, v) of depth z is the point z ((u - cx) / fx, (v - cy) / fy, 1). */
typedef struct conicflow_camera {
    uint32_t width;
    uint32_t height;
    double fx;
    double fy;
    double cx;
    double cy;
} conicflow_camera;

/* Values of conicflow_object.kind. */
enum { CONICFLOW_SPHERE = 0, CONICFLOW_CYLINDER = 1, CONICFLOW_CONE = 2 };

/* Standard deviations; zero for parameters that a shape lacks. */
typedef struct conicflow_sigma {
    double center_covariance[3][3]; /* of the centre, in square metres; the diagonal has the variances along x, y, z */
    double axis;                    /* root mean square of the angle between the estimated and the true axis */
    double radius;
    double length;
    double half_angle;
} conicflow_sigma;

/* A sphere, cylinder or cone in the camera frame; parameters that a shape lacks are zero. */
typedef struct conicflow_object {
    uint32_t kind;      /* CONICFLOW_SPHERE, CONICFLOW_CYLINDER or CONICFLOW_CONE */
    uint32_t points;    /* number of measurements that support it */
    uint32_t rows;      /* number of scan lines that support it */
    float confidence;   /* probability that it is an object of this shape */
    double center[3];   /* centre of a sphere, or the middle of the visible part of a cylinder or cone, on the axis */
    double axis[3];     /* unit vector; for a cone from the apex to the base */
    double radius;      /* for a cone at `center` */
    double length;      /* of the visible part along the axis */
    double half_angle;  /* of a cone */
    double base_radius; /* of a cone at the wide end of its visible part */
    double top_radius;  /* of a cone at the narrow end of its visible part */
    double apex[3];     /* of a cone; may lie outside the visible part */
    conicflow_sigma sigma;
    double rms;         /* root mean square distance of the points from the surface in excess of the noise */
    double arc;         /* visible part of the circumference */
} conicflow_object;

typedef struct conicflow_detector conicflow_detector;

/*
 * Creates a detector for the images of one camera; returns NULL on failure, and conicflow_error() returns the reason.
 *
 * depth_scale: metres per unit of a pixel of conicflow_detect, 0.001 for millimetres.
 * noise: the sensor, "kinect_v1", "realsense_d435", "time_of_flight" or "ideal"; NULL: "kinect_v1".
 */
conicflow_detector *conicflow_create(const conicflow_camera *camera, double depth_scale, const char *noise);

/*
 * Finds the objects of a depth image, which is stored row by row and has the size of the camera. 0 and 65535: no measurement.
 *
 * row_bytes: distance between the starts of consecutive rows; 0: there are no gaps between rows.
 * objects: is set to the objects, which belong to the detector and are valid until its next call; to NULL if there are none;
 *     unchanged on failure.
 * Returns the number of objects, or -1 on failure, and conicflow_error() returns the reason.
 */
int conicflow_detect(conicflow_detector *detector, const uint16_t *depth, size_t row_bytes,
                     const conicflow_object **objects);

/* The same for an image in metres; values that are not finite, not above zero or beyond 16.38 m are no measurement. */
int conicflow_detect_metres(conicflow_detector *detector, const float *depth, size_t row_bytes,
                            const conicflow_object **objects);

/* Frees a detector and its objects; NULL is allowed. */
void conicflow_free(conicflow_detector *detector);

/*
 * Returns the last error of this thread, with a hint on a separate line; "" if there was none. The text is valid until the next
 * error on this thread, or the end of the thread.
 */
const char *conicflow_error(void);

/* Returns the version of the library, which has to equal CONICFLOW_VERSION while that is below 1. */
const char *conicflow_version(void);

#ifdef __cplusplus
}
#endif

#endif
