// One map: its settings, its tensors, and what updates need besides.
#pragma once

#include <memory>
#include <mutex>
#include <string>
#include <vector>

#include "runtime/source/config.h"
#include "runtime/source/diagnosis/history.h"
#include "runtime/source/filters/chain.h"
#include "runtime/source/levels.h"
#include "tables.h"

constexpr size_t NUMBER_OF_TENSORS = sizeof(MapState) / sizeof(void*);

enum Layer {
    ELEVATION, VARIANCE, VALIDITY, TIME, UPPER_BOUND, TRAVERSABILITY, NORMAL_X, NORMAL_Y, NORMAL_Z,
    CEILING, CLEARANCE  // of a map with levels
};

// A value and whether it is known.
struct CellValue {
    float value;
    bool known;
};

struct torchelev_map;

std::vector<std::string> layers_of(const Config& cfg);  // of a map with these settings

// A layer as it is read, cell by cell.
struct LayerView {
    const torchelev_map& map;
    Layer layer;
    const Cells* made;  // by filters; null for a layer of the map

    CellValue at(int64_t cell) const;
};

struct torchelev_map {
    Config cfg;
    Settings settings;
    Sizes sizes;
    torchelev_limits limits;
    Own own;
    std::vector<std::unique_ptr<unsigned char[]>> tensors;  // in the order of STATE
    MapState state;                                         // their addresses
    std::unique_ptr<MapLevels> levels;                      // null without other surfaces than the ground
    std::vector<Stored> stored;                             // all tensors, those of the levels last
    float dt;                                               // [s] of the input
    std::vector<float> covariance;                          // (S, 6, 6) of the input
    std::vector<uint8_t> on_robot;                          // (S, N) of the input, with shapes of links
    robot_body::Posed posed;
    History history;
    std::string findings;  // of the last diagnosis
    mutable FilterChain filters;
    mutable std::mutex filtering;  // several threads may read

    torchelev_map(const std::string& text, const std::string& where, const torchelev_limits* limits);

    int64_t cells() const { return sizes.H * sizes.W; }
    double resolution() const { return settings.measure.resolution; }
    const Stored& find(const std::string& name) const;  // a tensor; raises Error
    void forget();                                      // make the map blank
    void update(const torchelev_input& input);
    void move(const double* T_map_base);
    void initialize(const double* feet, int64_t number, const std::string& method);
    void clear_around(double x, double y, double radius);
    // Measure the points of a past update again, into memory that the next update overwrites.
    const Measurement& measure_again(const PastUpdate& past);
    CellValue read(Layer layer, int64_t cell) const;  // a cell of a layer by its number
    LayerView view(const std::string& name) const;    // of a layer, or of one that filters make; raises Error
    // Refuse another grid than that of a scan or an image.
    void require_grid(int64_t height, int64_t width, double side, const char* reader) const;

  private:
    void check(const torchelev_input& input) const;
    void find_own(const torchelev_input& input);
    void run(const torchelev_input& input, const Stage* stages, int64_t number);
    void run_update(const torchelev_input& input);
    void set_sizes(const torchelev_input& input);
    Inputs inputs_of(const torchelev_input& input);
    void warm_up();
    template <class Change>
    void revise(const Change& change);
    void blank(int64_t cell);
};

// Refuse matrices (number, 4, 4) that are not given or not rigid, as `check_pose` does.
void require_poses(const char* name, const double* poses, int64_t number);
// Refuse matrices (number, 6, 6) that are no covariances, as `require_covariance` does.
void require_covariances(const double* values, int64_t number);

// A saved map: state_file.cpp.
void save_state(const torchelev_map& map, const std::string& path);
void load_state(torchelev_map& map, const std::string& path);
std::string read_file(const std::string& path);
