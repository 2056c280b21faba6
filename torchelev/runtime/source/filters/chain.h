// The filters of a config, in their order: filters/chain.py.
#pragma once

#include <functional>
#include <string>
#include <vector>

#include "runtime/source/filters/filters.h"
#include "runtime/source/json.h"

class FilterChain {
    struct Step {
        std::string layer;
        std::vector<std::string> inputs;
        std::function<void(const std::vector<const Cells*>&, Cells&)> run;
        Cells made;
        bool is_made;
    };
    Plane2D grid;
    std::vector<Step> steps;

    void add(const Json& entry, size_t number, const std::vector<std::string>& layers);

  public:
    // Read the list `filters` of a config. `layers` are those of the map. Raises Error.
    FilterChain(const std::vector<Json>& list, const Plane2D& grid, const std::vector<std::string>& layers);

    bool has(const std::string& layer) const;
    std::vector<std::string> names() const;
    void forget();  // what was made: the map has changed
    // Return a layer of the chain; `given(name, cells)` writes one of the map.
    const Cells& read(const std::string& layer, const std::function<void(const std::string&, Cells&)>& given);
};
