// The functions of torchelev.h.

#include <locale.h>

#include <cstring>
#include <new>

#include "runtime/source/diagnosis/diagnose.h"
#include "runtime/source/image.h"
#include "runtime/source/scan.h"

namespace {

thread_local std::string last_error;

// While it lives, this thread reads and writes numbers with a point, whatever the program's locale.
class NumbersOfC {
    locale_t before;

  public:
    NumbersOfC() {
        static const locale_t c = newlocale(LC_ALL_MASK, "C", nullptr);
        before = c ? uselocale(c) : nullptr;
    }
    ~NumbersOfC() {
        if (before) uselocale(before);
    }
};

// Do the work, and turn what it throws into a status.
template <class Work>
torchelev_status status_of(const Work& work) {
    const NumbersOfC numbers;
    try {
        work();
        return TORCHELEV_OK;
    } catch (const Error& error) {
        last_error = error.text;
        return error.status;
    } catch (const std::exception& error) {
        last_error = std::string("there is not enough memory, or not enough threads (") + error.what() + ")";
        return TORCHELEV_NO_MEMORY;
    }
}

template <class T>
T& given(const char* name, T* value) {
    REQUIRE(value, name, "must be given", "null", "see torchelev.h");
    return *value;
}

// A layer whose cells are computed as they are read; cells outside are not known.
struct CellsOfLayer {
    const LayerView view;

    scans::Read at(Lanes i, Lanes j) const {
        scans::Read found{splat(0), Flags{}};
        for (int l = 0; l < LANES; l++) {
            if (!(i[l] >= 0 && i[l] < float(view.map.sizes.H) && j[l] >= 0 && j[l] < float(view.map.sizes.W))) continue;
            const CellValue cell = view.at(int64_t(i[l]) * view.map.sizes.W + int64_t(j[l]));
            if (cell.known) found.value[l] = cell.value, found.known[l] = -1;
        }
        return found;
    }
};

void sample(const LayerView& view, scans::Mode mode, const double* xy, int64_t number, float* values,
            uint8_t* known) {
    const CellsOfLayer cells{view};
    const torchelev_map& map = view.map;
    for (int64_t first = 0; first < number; first += LANES) {
        float u[LANES]{}, v[LANES]{};
        const int count = int(std::min<int64_t>(LANES, number - first));
        for (int l = 0; l < count; l++) {
            u[l] = scans::to_cells(xy[2 * (first + l)], map.state.corner[0], map.resolution());
            v[l] = scans::to_cells(xy[2 * (first + l) + 1], map.state.corner[1], map.resolution());
        }
        const scans::Read found = scans::read(cells, load(u), load(v), mode);
        for (int l = 0; l < count; l++) {
            values[first + l] = found.known[l] ? found.value[l] : 0;
            if (known) known[first + l] = found.known[l] != 0;
        }
    }
}

// Put a new object where its pointer goes; null if it cannot be made.
template <class T, class Make>
torchelev_status make(const char* name, T** place, const Make& made) {
    return status_of([&] {
        T*& out = given(name, place);
        out = nullptr;
        out = made();
    });
}

}  // namespace

extern "C" {

const char* torchelev_last_error(void) { return last_error.c_str(); }

const char* torchelev_version(void) { return TORCHELEV_VERSION; }

torchelev_status torchelev_map_create(const char* config_path, const torchelev_limits* limits, torchelev_map** map) {
    return make("map", map,
                [&] { return new torchelev_map(read_file(&given("config_path", config_path)), config_path, limits); });
}

torchelev_status torchelev_map_create_from_text(const char* config, const torchelev_limits* limits,
                                                torchelev_map** map) {
    return make("map", map, [&] { return new torchelev_map(&given("config", config), "config", limits); });
}

void torchelev_map_free(torchelev_map* map) { delete map; }

torchelev_status torchelev_map_reset(torchelev_map* map) {
    return status_of([&] { given("map", map).forget(); });
}

torchelev_status torchelev_map_update(torchelev_map* map, const torchelev_input* input) {
    return status_of([&] { given("map", map).update(given("input", input)); });
}

torchelev_status torchelev_map_move(torchelev_map* map, const double* T_map_base) {
    return status_of([&] { given("map", map).move(T_map_base); });
}

torchelev_status torchelev_map_initialize(torchelev_map* map, const double* feet, int64_t number, const char* method) {
    return status_of([&] { given("map", map).initialize(feet, number, &given("method", method)); });
}

torchelev_status torchelev_map_clear_around(torchelev_map* map, const double center[2], double radius) {
    return status_of([&] {
        const double* xy = &given("center", center);
        given("map", map).clear_around(xy[0], xy[1], radius);
    });
}

torchelev_status torchelev_map_size(const torchelev_map* map, int64_t* rows, int64_t* columns, double* resolution) {
    return status_of([&] {
        const torchelev_map& m = given("map", map);
        if (rows) *rows = m.sizes.H;
        if (columns) *columns = m.sizes.W;
        if (resolution) *resolution = m.resolution();
    });
}

int32_t torchelev_map_num_links(const torchelev_map* map) { return map ? int32_t(map->cfg.body.links.size()) : 0; }

const char* torchelev_map_link_name(const torchelev_map* map, int32_t link) {
    const bool is_link = link >= 0 && link < torchelev_map_num_links(map);
    return is_link ? map->cfg.body.links[link].c_str() : nullptr;
}

torchelev_status torchelev_map_corner(const torchelev_map* map, double corner[2]) {
    return status_of([&] {
        const torchelev_map& m = given("map", map);
        for (int axis = 0; axis < 2; axis++)
            (&given("corner", corner))[axis] = double(m.state.corner[axis]) * m.resolution();
    });
}

torchelev_status torchelev_map_layer(const torchelev_map* map, const char* name, float* values, size_t size) {
    return status_of([&] {
        const torchelev_map& m = given("map", map);
        const LayerView view = m.view(&given("name", name));
        given("values", values);
        REQUIRE(size >= size_t(m.cells()), "size", "must be at least " + std::to_string(m.cells()),
                std::to_string(size), "see torchelev_map_size");
        for (int64_t k = 0; k < m.cells(); k++) {
            const CellValue cell = view.at(k);
            values[k] = cell.known ? cell.value : NAN;
        }
    });
}

const void* torchelev_map_tensor(const torchelev_map* map, const char* name, size_t* size_bytes) {
    const void* found = nullptr;
    status_of([&] {
        const torchelev_map& m = given("map", map);
        const Stored& tensor = m.find(&given("name", name));
        if (size_bytes) *size_bytes = tensor.bytes();
        found = tensor.data;
    });
    return found;
}

torchelev_status torchelev_map_sample(const torchelev_map* map, const char* name, const char* mode, const double* xy,
                                      int64_t num_points, float* values, uint8_t* known) {
    return status_of([&] {
        const torchelev_map& m = given("map", map);
        const LayerView view = m.view(&given("name", name));
        const std::string how = &given("mode", mode);
        REQUIRE(how == "bilinear" || how == "nearest", "mode", "must be one of bilinear, nearest", "'" + how + "'",
                "use bilinear");
        REQUIRE(num_points >= 0, "num_points", "must not be negative", std::to_string(num_points), "give M");
        if (num_points == 0) return;
        given("xy", xy), given("values", values);
        sample(view, how == "nearest" ? scans::NEAREST : scans::BILINEAR, xy, num_points, values, known);
    });
}

torchelev_status torchelev_map_statistics(const torchelev_map* map, torchelev_statistics* statistics) {
    return status_of([&] {
        const Statistics& s = given("map", map).state.statistics;
        given("statistics", statistics) = {*s.points_used,          *s.rejected_invalid,     *s.rejected_range,
                                           *s.rejected_body,        *s.rejected_overhang,    *s.rejected_outside,
                                           *s.rejected_outlier,     *s.rejected_edge,        *s.drift_points,
                                           *s.drift_error,          *s.drift_correction,     *s.disagreement,
                                           *s.cleared_seen_through, *s.cleared_other_floors, *s.cells_bounded};
    });
}

torchelev_status torchelev_map_diagnose(torchelev_map* map, const char** findings) {
    return status_of([&] {
        torchelev_map& m = given("map", map);
        const char*& found = given("findings", findings);
        m.findings = diagnose(m);
        found = m.findings.c_str();
    });
}

torchelev_status torchelev_map_save(const torchelev_map* map, const char* path) {
    return status_of([&] { save_state(given("map", map), &given("path", path)); });
}

torchelev_status torchelev_map_load(torchelev_map* map, const char* path) {
    return status_of([&] { load_state(given("map", map), &given("path", path)); });
}

torchelev_status torchelev_scan_create(const torchelev_map* map, const char* layout, torchelev_scan** scan) {
    return make("scan", scan, [&] { return new torchelev_scan(given("map", map), &given("layout", layout)); });
}

void torchelev_scan_free(torchelev_scan* scan) { delete scan; }

int64_t torchelev_scan_size(const torchelev_scan* scan) { return scan ? scan->size() : 0; }

int64_t torchelev_scan_num_feet(const torchelev_scan* scan) { return scan ? scan->feet() : 0; }

torchelev_status torchelev_scan_read(torchelev_scan* scan, const torchelev_map* map, const double* T_map_base,
                                     const double* feet, float* values, uint8_t* known) {
    return status_of([&] {
        torchelev_scan& s = given("scan", scan);
        given("values", values);
        s.read(given("map", map), T_map_base, feet, values, known);
    });
}

torchelev_status torchelev_image_create(const torchelev_map* map, const char* settings, torchelev_image** image) {
    return make("image", image, [&] { return new torchelev_image(given("map", map), &given("settings", settings)); });
}

void torchelev_image_free(torchelev_image* image) { delete image; }

torchelev_status torchelev_image_shape(const torchelev_image* image, int64_t shape[3]) {
    return status_of([&] { std::copy_n(given("image", image).shape, 3, &given("shape", shape)); });
}

torchelev_status torchelev_image_read(torchelev_image* image, const torchelev_map* map, const double* T_map_base,
                                      float* values) {
    return status_of([&] { given("image", image).read(given("map", map), T_map_base, &given("values", values)); });
}

}  // extern "C"
