// The filters of a config, in their order: filters/chain.py and registry.py.

#include "runtime/source/filters/chain.h"

#include <algorithm>
#include <cctype>
#include <cmath>

#include "runtime/source/filters/kinds.h"

namespace {

bool holds(const std::vector<std::string>& names, const std::string& name) {
    return std::find(names.begin(), names.end(), name) != names.end();
}

bool is_identifier(const std::string& name) {
    auto is_letter = [](char c) { return std::isalpha(static_cast<unsigned char>(c)) || c == '_'; };
    auto fits = [&](char c) { return is_letter(c) || std::isdigit(static_cast<unsigned char>(c)); };
    return !name.empty() && is_letter(name[0]) && std::all_of(name.begin(), name.end(), fits);
}

const std::string& text_of(const Json& entry, const char* key, size_t number) {
    const Json* value = entry.find(key);
    REQUIRE(value && value->kind == Json::STRING, "config.filters[" + std::to_string(number) + "]",
            "must name its layer and its filter", entry.describe(),
            "write one as {layer: smooth, filter: gaussian, sigma: 0.1}");
    return value->text;
}

std::vector<std::string> inputs_of(const Json& entry, const std::string& where) {
    const Json* inputs = entry.find("inputs");
    if (!inputs) return {"elevation"};
    if (inputs->kind == Json::STRING) return {inputs->text};
    std::vector<std::string> names;
    bool are_names = inputs->kind == Json::ARRAY;
    for (const Json& item : inputs->items) are_names &= item.kind == Json::STRING, names.push_back(item.text);
    REQUIRE(are_names, where + ".inputs", "must be names of layers", inputs->describe(), "give a list of names");
    return names.empty() ? std::vector<std::string>{"elevation"} : names;
}

// Results that are not finite are unknown, and unknown ones 0: `_run` of registry.py.
void zero_unknown(Cells& layer) {
    for (size_t k = 0; k < layer.values.size(); k++) {
        layer.known[k] = layer.known[k] && std::isfinite(layer.values[k]);
        if (!layer.known[k]) layer.values[k] = 0;
    }
}

}  // namespace

FilterChain::FilterChain(const std::vector<Json>& list, const FilterGrid& grid, const std::vector<std::string>& layers)
    : grid(grid) {
    for (size_t k = 0; k < list.size(); k++) add(list[k], k, layers);
}

void FilterChain::add(const Json& entry, size_t number, std::vector<std::string> available) {
    const std::string &name = text_of(entry, "layer", number), &filter = text_of(entry, "filter", number);
    const std::string where = "filters." + name, before = where + ": ";
    for (const Step& step : steps) available.push_back(step.layer);
    REQUIRE(is_identifier(name) && !holds(available, name), where, "must be a name of its own, of letters and digits",
            "'" + name + "'", "rename it");
    const std::vector<std::string> inputs = inputs_of(entry, where);
    std::vector<std::string> missing;
    for (const std::string& input : inputs)
        if (!holds(available, input)) missing.push_back(input);
    REQUIRE(missing.empty(), where, "must read layers that are made before it", joined(missing),
            "there are " + joined(available));
    const FilterKind& kind = filter_kind(filter, before);
    require_settings(entry, filter, before);
    REQUIRE(inputs.size() == kind.inputs, before + "filter " + filter,
            "takes " + std::to_string(kind.inputs) + " layers", std::to_string(inputs.size()) + " inputs",
            "name as many inputs");
    const size_t cells = size_t(grid.cells());
    steps.push_back({name, inputs, kind.make(entry, before, grid),
                     {std::vector<float>(cells), std::vector<uint8_t>(cells)}, false});
}

size_t FilterChain::find(const std::string& layer) const {
    size_t k = 0;
    while (k < steps.size() && steps[k].layer != layer) k++;
    return k;
}

std::string FilterChain::listed() const {
    std::string all;
    for (const Step& step : steps) all += ", " + step.layer;
    return all;
}

void FilterChain::forget() {
    for (Step& step : steps) step.is_made = false;
}

const Cells& FilterChain::read(const std::string& layer, const ReadMap& given) {
    Step& step = steps[find(layer)];
    if (step.is_made) return step.made;
    std::vector<Cells> of_map(step.inputs.size());
    std::vector<const Cells*> from;
    for (size_t k = 0; k < step.inputs.size(); k++) {
        const std::string& input = step.inputs[k];
        if (has(input)) {
            from.push_back(&read(input, given));
            continue;
        }
        of_map[k] = {std::vector<float>(size_t(grid.cells())), std::vector<uint8_t>(size_t(grid.cells()))};
        given(input, of_map[k]);
        from.push_back(&of_map[k]);
    }
    step.run(from, step.made);
    zero_unknown(step.made);
    step.is_made = true;
    return step.made;
}
