// Settings of a map: config.py, read from JSON, with the same names, rules and defaults.
#pragma once

#include <string>
#include <vector>

#include "generated.h"
#include "robot_body/kernel/own_points.h"
#include "runtime/source/json.h"

// The shapes of a robot's links: shapes.py.
struct RobotBody {
    std::vector<std::string> links;
    std::vector<robot_body::Capsule> capsules;
    std::vector<robot_body::Box> boxes;
    double padding = 0, depth_tolerance = 0;
    std::string text;  // all numbers, to compare configs

    RobotBody() = default;
    explicit RobotBody(const Json& body);
    robot_body::Body packed() const;

  private:
    int link_of(const Json& shape, const std::string& where);
    void add_capsule(const Json& capsule);
    void add_box(const Json& box);
};

class Config {
    struct Entry {
        bool is_null;
        double values[3];
    };
    std::vector<Entry> entries;  // in the order of SETTINGS

    static size_t find(const std::string& name);
    void read_group(const Json& group, const std::string& prefix);
    void read_setting(size_t k, const Json& value);
    void read_group_setting(size_t k, const Json& value);
    void read_place(size_t k, const Json& value);
    void read_choice(size_t k, const Json& value);
    void check() const;
    void check_grid() const;
    void check_sensor() const;
    void check_drift() const;
    void check_fusion() const;
    void check_rays() const;
    void check_surface() const;
    void check_levels() const;
    void require_rule(bool holds, const std::string& name, const std::string& rule, const std::string& hint) const;
    void require_at_least(const std::string& name, double least, const std::string& rule,
                          const std::string& hint) const;

  public:
    RobotBody body;  // of `sensor.body`, if that has shapes of links
    Json filters;    // the list; null if it is left out

    // Read the text of a file; errors name it. Raises Error.
    Config(const std::string& text, const std::string& where);

    bool has(const std::string& name) const { return !entries[find(name)].is_null; }
    double operator[](const std::string& name) const { return entries[find(name)].values[0]; }
    const double* place(const std::string& name) const { return entries[find(name)].values; }
    std::string word(const std::string& name) const;  // of a CHOICE
    bool has_levels() const;                          // surfaces besides the ground
    int64_t rows() const;
    int64_t columns() const;
    // The least traversability of cells that measure the drift: `drift_gate`.
    double drift_gate() const;
    // All settings, whatever was given and what was left out: a canonical text, to compare configs.
    std::string canonical() const;
};

// What the equations need of a config: `settings` of each stage's kernel.py.
Settings settings_of(const Config& cfg);
