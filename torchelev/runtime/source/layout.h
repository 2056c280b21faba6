// Settings of height scans and images as JSON, and where their points lie: scan_layout.py and patterns.py.
#pragma once

#include <algorithm>
#include <cmath>
#include <initializer_list>
#include <string>
#include <vector>

#include "runtime/source/config.h"

// The place of a value among others; refused if it is none of them.
inline int place_of(const std::string& name, const std::string& value, std::initializer_list<const char*> values) {
    const auto found = std::find(values.begin(), values.end(), value);
    REQUIRE(found != values.end(), name, "must be one of " + joined(values), "'" + value + "'", "see the docs");
    return int(found - values.begin());
}

// Settings of a scan or an image as JSON; errors begin with their name.
class Layout {
    const std::string name;
    const Json root;

    static const Json& null() {
        static const Json value;
        return value;
    }

  public:
    Layout(const std::string& name, const std::string& text, std::initializer_list<const char*> keys)
        : name(name), root(JsonReader::read(text, name)) {
        REQUIRE(root.kind == Json::OBJECT, name, "must be a mapping", root.type(), "see torchelev.h");
        for (const auto& [key, value] : root.members) {
            const bool is_of_channels = key == "channels" || key == "channel_fill";
            REQUIRE(!is_of_channels, named(key), "needs Python: this library has no channels", value.describe(),
                    "leave it out", TORCHELEV_UNSUPPORTED);
            const bool is_of_ceilings = key == "surface" || key == "no_ceiling";
            REQUIRE(!is_of_ceilings, named(key), "needs Python: this library scans no ceilings", value.describe(),
                    "read an image's clearance, or leave it out", TORCHELEV_UNSUPPORTED);
            place_of(named(key), key, keys);
        }
    }

    std::string named(const std::string& key) const { return name + "." + key; }

    const Json& operator[](const std::string& key) const {
        const Json* found = root.find(key);
        return found ? *found : null();
    }

    double number(const std::string& key, double usual, double least = -INFINITY) const {
        const Json& value = (*this)[key];
        if (value.kind == Json::NUL) return usual;
        const bool fits = value.kind == Json::NUMBER && std::isfinite(value.number) && value.number >= least;
        REQUIRE(fits, named(key), "must be a finite number", value.describe(), "leave it out for its default");
        return value.number;
    }

    int64_t count(const std::string& key, int64_t usual) const {
        const double value = number(key, double(usual), 0);
        REQUIRE(value == std::floor(value) && value < 1e6, named(key), "must be an int of at least 0", repr(value),
                "leave it out for its default");
        return int64_t(value);
    }

    std::string text(const std::string& key, const char* usual) const {
        const Json& value = (*this)[key];
        if (value.kind == Json::NUL) return usual;
        REQUIRE(value.kind == Json::STRING, named(key), "must be a name", value.describe(),
                std::string("give ") + usual);
        return value.text;
    }

    std::vector<double> points() const {
        const Json& pattern = (*this)["pattern"];
        std::vector<double> xy;
        bool fits = pattern.kind == Json::ARRAY && !pattern.items.empty();
        for (const Json& point : pattern.items) {
            fits = fits && point.kind == Json::ARRAY && point.items.size() == 2;
            for (const Json& coordinate : point.items) {
                fits = fits && coordinate.kind == Json::NUMBER && std::isfinite(coordinate.number);
                xy.push_back(coordinate.number);
            }
        }
        REQUIRE(fits, named("pattern"), "must be one or more points (x, y)", pattern.describe(),
                "give [[x, y], ...] in metres");
        return xy;
    }

    // Which of these names a text is, by its place among them.
    int choice(const std::string& key, const char* usual, std::initializer_list<const char*> values) const {
        return place_of(named(key), text(key, usual), values);
    }
};

// How far [m] points reach from the origin of a pattern that moves with the robot: `Pattern` of patterns.py.
struct Span {
    double x, y;

    Span(const std::vector<double>& xy, int32_t alignment, double reach);

    // Refuse a window that cannot hold the points at every heading.
    void require_inside(const Config& cfg) const;
};
