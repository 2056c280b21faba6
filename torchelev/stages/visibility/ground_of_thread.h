// The ground that a sensor's rays may meet, cell by cell, for a GPU's threads: accepted_rays.py and horizon.py.
#pragma once

#include <algorithm>
#include <limits>

#include "kernels/cuda/update.h"
#include "stages/visibility/equation.h"
#include "stages/window.h"

// One map as the sensor of a launch sees it.
struct Ground {
    const VisibilitySettings& s;
    const MapState map;
    const int64_t* anchor;
    const int32_t rows, columns;
    visibility::View view;

    Ground(const Update& u, int64_t b)
        : s(u.settings.visibility), map(u.state.at(b, u.sizes)), anchor(u.scratch.anchor + 2 * b),
          rows(int32_t(u.sizes.H)), columns(int32_t(u.sizes.W)) {
        for (int k = 0; k < 3; k++) view.origin[k] = u.scratch.origin[3 * (b * u.sizes.S + u.sensor) + k];
        for (int axis = 0; axis < 2; axis++) {
            const float offset = lattice_offset(map.corner, anchor, axis, s.resolution);
            view.start[axis] = view.origin[axis] + offset;
            view.first[axis] = rintf(offset / s.resolution);
            view.size[axis] = float(axis ? columns : rows);
        }
    }

    // [m] from the sensor to the centre of a row (axis 0) or column (axis 1).
    float to_center(int axis, int64_t k) const {
        return center_offset(map.corner, anchor, axis, k, s.resolution) - view.origin[axis];
    }

    // How far below the sensor the lowest ground at a place lies [m], which is counted from the sensor.
    float below_sensor(float x, float y) const {
        const float i = visibility::cell_of(view.origin[0] + x, 0, view, s);
        const float j = visibility::cell_of(view.origin[1] + y, 1, view, s);
        if (!(i >= 0 && i < rows && j >= 0 && j < columns)) return s.no_fall * (2 * s.resolution);
        const int32_t k = int32_t(i) * columns + int32_t(j);
        return visibility::below_sensor(lowest(k), bool(map.validity[k]), map.time[k], view.origin[2], s);
    }

    // The lowest ground of a cell [m], infinite where it is not well supported.
    float floor_at(int32_t i, int32_t j) const {
        return is_supported(i, j) ? lowest(i * columns + j) : std::numeric_limits<float>::infinity();
    }

    // The lowest well supported ground [m] near a border, across it, at a place along it: `border_minima`.
    float border_minimum(int32_t side, int32_t place) const {
        const int32_t size = side < 2 ? rows : columns;
        float lowest = s.nowhere;
        for (int32_t n = 0; n < std::min(s.near_cells, size); n++) {
            const int32_t across = side % 2 ? size - 1 - n : n;
            const int32_t i = side < 2 ? across : place, j = side < 2 ? place : across;
            if (is_supported(i, j)) lowest = smaller(lowest, map.elevation[i * columns + j]);
        }
        return lowest;
    }

  private:
    float lowest(int32_t k) const { return map.elevation[k] - visibility::height_margin(map.variance[k], s); }

    // `sure_height` of a cell, and NOWHERE outside the window.
    float sure(int32_t i, int32_t j) const {
        if (i < 0 || i >= rows || j < 0 || j >= columns) return s.nowhere;
        const int32_t k = i * columns + j;
        return visibility::sure_height(map.elevation[k], bool(map.validity[k]), map.support[k], s);
    }

    bool is_supported(int32_t i, int32_t j) const {
        const int32_t k = i * columns + j;
        return map.validity[k] && visibility::well_supported(map.elevation[k], true, sure(i, j), sure(i - 1, j),
                                                             sure(i + 1, j), sure(i, j - 1), sure(i, j + 1), s);
    }
};
