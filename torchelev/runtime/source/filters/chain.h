// The filters of a config, in their order: filters/chain.py.
#pragma once

#include <functional>
#include <string>
#include <vector>

#include "runtime/source/filters/filters.h"
#include "runtime/source/json.h"

class FilterChain {
  public:
    typedef std::function<void(const std::vector<const Cells*>&, Cells&)> Run;
    typedef std::function<void(const std::string&, Cells&)> ReadMap;

    // Read the list `filters` of a config. `layers` are those of the map. Raises Error.
    FilterChain(const std::vector<Json>& list, const FilterGrid& grid, const std::vector<std::string>& layers);

    bool has(const std::string& layer) const { return find(layer) < steps.size(); }
    std::string listed() const;  // the names of its layers, a comma before each
    void forget();               // what was made: the map has changed
    // Return a layer of the chain; `given(name, cells)` writes one of the map.
    const Cells& read(const std::string& layer, const ReadMap& given);

  private:
    struct Step {
        std::string layer;
        std::vector<std::string> inputs;
        Run run;
        Cells made;
        bool is_made;
    };
    FilterGrid grid;
    std::vector<Step> steps;

    size_t find(const std::string& layer) const;  // its number; that of steps without it
    void add(const Json& entry, size_t number, std::vector<std::string> available);
};
