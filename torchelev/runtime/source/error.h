// Errors of the C library: a code and Python's sentence.
#pragma once

#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <utility>

#include "runtime/include/torchelev.h"

struct Error {
    torchelev_status status;
    std::string text;
};

// "argument: rule, got actual; hint", as errors.py words it.
inline std::string message(const std::string& argument, const std::string& rule, const std::string& actual,
                           const std::string& hint) {
    return argument + ": " + rule + ", got " + actual + "; " + hint;
}

[[noreturn]] inline void refuse(const std::string& argument, const std::string& rule, const std::string& actual,
                                const std::string& hint, torchelev_status status = TORCHELEV_BAD_VALUE) {
    throw Error{status, message(argument, rule, actual, hint)};
}

// Refuse by these sentences, which are composed only then, unless the rule holds.
#define REQUIRE(holds, ...)                \
    do {                                   \
        if (!(holds)) refuse(__VA_ARGS__); \
    } while (false)

// Texts with commas between them.
template <class Texts>
std::string joined(const Texts& texts) {
    std::string all;
    for (const auto& text : texts) all += (all.empty() ? "" : ", ") + std::string(text);
    return all;
}

// A number as Python prints it with `:g` and so many digits.
inline std::string general(double value, int digits = 6) {
    char text[64];
    std::snprintf(text, sizeof text, "%.*g", digits, value);
    return text;
}

// A float as Python's repr writes it: the fewest digits that read back as the same number.
inline std::string repr(double value) {
    if (!std::isfinite(value)) return std::isnan(value) ? "nan" : value > 0 ? "inf" : "-inf";
    char text[64];
    int digits = 1;
    do std::snprintf(text, sizeof text, "%.*e", digits - 1, value);
    while (std::strtod(text, nullptr) != value && ++digits <= 17);
    const int exponent = std::atoi(std::string(text).substr(std::string(text).find('e') + 1).c_str());
    if (exponent >= 16 || exponent < -4) return general(value, digits);
    std::snprintf(text, sizeof text, "%.*f", digits - 1 > exponent ? digits - 1 - exponent : 1, value);
    return text;
}
