// The filters that the library has, by name.
#pragma once

#include <string>

#include "runtime/source/filters/chain.h"

struct FilterKind {
    const char* name;
    size_t inputs;  // how many layers it reads
    // Check an entry's settings, of which errors call each `where` + its name, and return what the filter does.
    FilterChain::Run (*make)(const Json& entry, const std::string& where, const FilterGrid& grid);
};

// Return a filter by name. Raises Error.
const FilterKind& filter_kind(const std::string& name, const std::string& where);

// Refuse settings that a filter does not have.
void require_settings(const Json& entry, const std::string& filter, const std::string& where);
