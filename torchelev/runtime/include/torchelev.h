/**
 * The map of torchelev without Python: libtorchelev, a C library.
 *
 * It updates maps by the same C++ as `torchelev.ElevationMap` on a CPU, and gives the same bits. Frames, units and the
 * meaning of all values are those of Python: metres, seconds, radians; matrices are 4 x 4, row by row, and T_a_b takes
 * points of frame b into frame a.
 *
 * Errors: functions return a status; `torchelev_last_error` then holds the sentence that Python raises. Nothing has
 * changed when a function fails, but for TORCHELEV_NO_MEMORY.
 *
 * Threads: a map, a scan or an image belongs to one thread at a time; different ones may be used at the same time. What
 * reads a map (layers, samples, statistics) may run on several threads while none updates it.
 *
 * Memory: after a map, a scan or an image is created, updates and reads allocate nothing. A diagnosis does, and so do
 * the first read of a filter's layer after an update, and updates of a map with levels that meet more surfaces than those
 * before, or run on a thread that updated no map with levels as large before.
 */
#ifndef TORCHELEV_H
#define TORCHELEV_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/** What a function did. */
typedef enum {
    TORCHELEV_OK = 0,
    TORCHELEV_BAD_VALUE = 1,   /**< an argument or a setting breaks a rule */
    TORCHELEV_BAD_FILE = 2,    /**< a file cannot be read or written, is damaged, or is of another version */
    TORCHELEV_UNSUPPORTED = 3, /**< a setting needs Python: a learned head, some filters */
    TORCHELEV_NO_MEMORY = 4    /**< there is not enough memory */
} torchelev_status;

/** One robot-centric map. */
typedef struct torchelev_map torchelev_map;

/** Points at which a policy reads heights, and how: `torchelev.HeightScan`. */
typedef struct torchelev_scan torchelev_scan;

/** An image of the map around the robot: `torchelev.MapImage`. */
typedef struct torchelev_image torchelev_image;

/** How large updates may be. Memory for them is allocated when a map is created. */
typedef struct {
    int64_t max_points;  /**< points of all sensors of one update */
    int32_t max_sensors; /**< sensors of one update */
    int32_t num_threads; /**< threads that share an update, the caller included */
} torchelev_limits;

/** One update's input: `ElevationMap.update` with one environment. Null where a value is not given. */
typedef struct {
    int32_t num_sensors;           /**< S */
    int64_t num_points;            /**< N, of each sensor; pad with NaN */
    const float* points;           /**< (S, N, 3) [m] sensor frame; NaN or inf where there is no return */
    const double* T_map_sensor;    /**< (S, 4, 4) */
    const double* T_map_base;      /**< (4, 4) the robot, which the window follows; null: the window stays */
    const double* T_base_links;    /**< (K, 4, 4) the links of `sensor.body`, from joint angles; null without */
    double dt;                     /**< [s] since the last update; 0 for a further sensor of the same instant */
    const float* variance;         /**< (S, N) [m^2] of each height, or null: the noise model's */
    const double* pose_covariance; /**< (S, 6, 6) x, y, z, rotations about the map's axes; null: poses are exact */
} torchelev_input;

/** What the last update did: `torchelev.Statistics`. */
typedef struct {
    int64_t points_used;          /**< fused into a cell's height */
    int64_t rejected_invalid;     /**< NaN or inf */
    int64_t rejected_range;       /**< nearer or farther than the sensor measures */
    int64_t rejected_body;        /**< on the robot itself */
    int64_t rejected_overhang;    /**< above the exclusion ramp */
    int64_t rejected_outside;     /**< not over the window */
    int64_t rejected_outlier;     /**< outside the Mahalanobis gate */
    int64_t rejected_edge;        /**< on the wrong side of a step within their cell */
    int64_t drift_points;         /**< that measured the height drift */
    double drift_error;           /**< [m] mean height error of these points */
    double drift_correction;      /**< [m] added to the map's heights */
    double disagreement;          /**< [m] by which sensors, or successive scans, disagree in height */
    int64_t cleared_seen_through; /**< cells that visibility clean-up removed */
    int64_t cleared_other_floors; /**< cells that overlap clearance removed */
    int64_t cells_bounded;        /**< unknown cells that have an upper bound */
} torchelev_statistics;

#ifdef __GNUC__
#pragma GCC visibility push(default)  // the library exports these functions alone
#endif

/** Return this thread's last error as a sentence, or "" before the first one. Valid until the thread's next error. */
const char* torchelev_last_error(void);

/** Return the library's version, as "0.1.0". */
const char* torchelev_version(void);

/* Maps ------------------------------------------------------------------------------------------------------------ */

/**
 * Create a map of a config file, which `ElevationMapConfig.save` wrote or which a person did: JSON, settings by group
 * and name; settings that are left out keep their defaults.
 *
 * @param config_path the file.
 * @param limits how large updates may be; null: 131,072 points of 4 sensors on one thread.
 * @param map the new map, of which nothing is known; free it with `torchelev_map_free`.
 */
torchelev_status torchelev_map_create(const char* config_path, const torchelev_limits* limits, torchelev_map** map);

/** Create a map of a config's text in place of a file. */
torchelev_status torchelev_map_create_from_text(const char* config, const torchelev_limits* limits,
                                                torchelev_map** map);

/** Free a map; null is ignored. */
void torchelev_map_free(torchelev_map* map);

/** Forget everything, as when the robot starts over. */
torchelev_status torchelev_map_reset(torchelev_map* map);

/** Fuse the points of one instant. */
torchelev_status torchelev_map_update(torchelev_map* map, const torchelev_input* input);

/** Move the window to the robot, T_map_base (4, 4), without new points. */
torchelev_status torchelev_map_move(torchelev_map* map, const double* T_map_base);

/**
 * Estimate the unknown cells from ground points, such as the feet that a robot stands on: `ElevationMap.initialize`.
 *
 * @param feet (K, 3) [m] map frame.
 * @param number K.
 * @param method "linear" fills the convex hull of the feet, "nearest" the whole window.
 */
torchelev_status torchelev_map_initialize(torchelev_map* map, const double* feet, int64_t number, const char* method);

/** Forget the cells whose centres lie within a radius [m] of a place (x, y) [m] in the map frame. */
torchelev_status torchelev_map_clear_around(torchelev_map* map, const double center[2], double radius);

/** Write H and W, the cells along x and y, and the side of a cell [m]. Each pointer may be null. */
torchelev_status torchelev_map_size(const torchelev_map* map, int64_t* rows, int64_t* columns, double* resolution);

/** Return K, the links whose poses updates take: those of the shapes in the config's `sensor.body`. */
int32_t torchelev_map_num_links(const torchelev_map* map);

/** Return the name of a link, from 0 to K - 1; null beyond. Valid as long as the map. */
const char* torchelev_map_link_name(const torchelev_map* map, int32_t link);

/** Write the position [m] of the window's corner (x, y): cell (i, j) spans i to i + 1 and j to j + 1 cells from it. */
torchelev_status torchelev_map_corner(const torchelev_map* map, double corner[2]);

/**
 * Copy a layer: "elevation", "variance", "validity", "time", "upper_bound", "traversability", "normal_x", "normal_y",
 * "normal_z", of a map with levels "ceiling" and "clearance" (inf: nothing hangs there), or one of the config's filters.
 *
 * @param values (H, W), NaN where not known.
 * @param size number of values that fit.
 */
torchelev_status torchelev_map_layer(const torchelev_map* map, const char* name, float* values, size_t size);

/**
 * Return a tensor of the state by its name in Python, such as "elevation" or "validity": its memory, (H, W), which
 * updates overwrite; null, with an error, without such a tensor. Those of levels begin with "levels_", as in a saved map.
 *
 * @param size_bytes written, unless null.
 */
const void* torchelev_map_tensor(const torchelev_map* map, const char* name, size_t* size_bytes);

/**
 * Read a layer at points.
 *
 * @param name as in `torchelev_map_layer`.
 * @param mode "bilinear" or "nearest", as in `ElevationMap.sample`.
 * @param xy (M, 2) [m] map frame.
 * @param num_points M.
 * @param values (M), 0 where not known.
 * @param known (M), 1 or 0; null: not wanted.
 */
torchelev_status torchelev_map_sample(const torchelev_map* map, const char* name, const char* mode, const double* xy,
                                      int64_t num_points, float* values, uint8_t* known);

/** Write what the last update did. */
torchelev_status torchelev_map_statistics(const torchelev_map* map, torchelev_statistics* statistics);

/**
 * Describe what looks wrong with the inputs: `ElevationMap.diagnose`, without the rules that fit planes and poses.
 *
 * It names points in millimetres or in another frame, a base that moves against its sensor, sensors that take turns and
 * disagree in height, gates that reject nearly everything, a window beside the points, a stage that clears most cells,
 * scans that contradict the map, and a wrong `dt`. It looks at a few of the updates since the last reset, of which the
 * map keeps up to 3,000 points of each sensor. It allocates memory.
 *
 * @param findings a sentence on each line, worst first; "" if nothing is found. Valid until the next diagnosis, or until
 * the map is freed.
 */
torchelev_status torchelev_map_diagnose(torchelev_map* map, const char** findings);

/**
 * Save everything that the next update needs, as a file of safetensors. An existing file is replaced as a whole or,
 * with an error, left as it was.
 */
torchelev_status torchelev_map_save(const torchelev_map* map, const char* path);

/** Load a file of `torchelev_map_save` of the same config. */
torchelev_status torchelev_map_load(torchelev_map* map, const char* path);

/* Height scans ---------------------------------------------------------------------------------------------------- */

/**
 * Create a scan for a map.
 *
 * @param map the map whose grid it reads; any other of the same grid will do, too.
 * @param layout "isaac_lab", "mjlab" or "legged_gym", or a layout as JSON: what `scan_layout` returned in Python.
 * @param scan the new scan; free it with `torchelev_scan_free`.
 */
torchelev_status torchelev_scan_create(const torchelev_map* map, const char* layout, torchelev_scan** scan);

/** Free a scan; null is ignored. */
void torchelev_scan_free(torchelev_scan* scan);

/** Return the number of values. */
int64_t torchelev_scan_size(const torchelev_scan* scan);

/** Return K, the feet that a read takes; 0 for a scan around the base. */
int64_t torchelev_scan_num_feet(const torchelev_scan* scan);

/**
 * Read the heights, as `HeightScan` does without noise.
 *
 * @param T_map_base (4, 4) the robot.
 * @param feet (K, 3) [m] map frame, of a scan around feet; else null.
 * @param values (P), never NaN.
 * @param known (P), 1 where the elevation is known; null: not wanted.
 */
torchelev_status torchelev_scan_read(torchelev_scan* scan, const torchelev_map* map, const double* T_map_base,
                                     const double* feet, float* values, uint8_t* known);

/* Images ---------------------------------------------------------------------------------------------------------- */

/**
 * Create an image for a map.
 *
 * @param map the map whose grid it reads; any other of the same grid will do, too.
 * @param settings the fields of `MapImage` as JSON; those that are left out keep their defaults.
 * @param image the new image; free it with `torchelev_image_free`.
 */
torchelev_status torchelev_image_create(const torchelev_map* map, const char* settings, torchelev_image** image);

/** Free an image; null is ignored. */
void torchelev_image_free(torchelev_image* image);

/** Write its channels, rows and columns. */
torchelev_status torchelev_image_shape(const torchelev_image* image, int64_t shape[3]);

/**
 * Read the image, as `MapImage` does.
 *
 * @param T_map_base (4, 4) the robot.
 * @param values (C, H, W), never NaN.
 */
torchelev_status torchelev_image_read(torchelev_image* image, const torchelev_map* map, const double* T_map_base,
                                      float* values);

#ifdef __GNUC__
#pragma GCC visibility pop
#endif
#ifdef __cplusplus
}
#endif

#endif
