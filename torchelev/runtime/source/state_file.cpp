// Files of a whole map, as safetensors: eight bytes with the length of a JSON header, the header, the tensors.
#include <sys/stat.h>
#include <unistd.h>

#include <cerrno>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <memory>

#include "runtime/source/map.h"

namespace {

const char* const FORMAT = "torchelev map";
const char* const VERSION = "1";
constexpr uint64_t LONGEST = 1 << 20;  // [bytes] of a header

using File = std::unique_ptr<std::FILE, int (*)(std::FILE*)>;

std::string control_character(char c) {
    char text[8];
    std::snprintf(text, sizeof text, "\\u%04x", static_cast<unsigned>(static_cast<unsigned char>(c)));
    return text;
}

std::string quoted(const std::string& text) {
    std::string out = "\"";
    for (const char c : text) {
        if (c == '\n') out += "\\n";
        else if (c == '"' || c == '\\') out += std::string("\\") + c;
        else if (static_cast<unsigned char>(c) < 0x20) out += control_character(c);
        else out += c;
    }
    return out + "\"";
}

std::string shape_of(const Stored& tensor) {
    std::string text = "[1";
    for (const int64_t size : tensor.shape) text += "," + std::to_string(size);
    return text + "]";
}

// The header, padded to whole eight bytes.
std::string header_of(const torchelev_map& map) {
    std::string text = "{\"__metadata__\":{\"format\":" + quoted(FORMAT) + ",\"version\":" + quoted(VERSION) +
                       ",\"config\":" + quoted(map.cfg.canonical()) + "}";
    size_t at = 0;
    for (const Stored& tensor : map.stored) {
        const size_t end = at + tensor.bytes();
        text += "," + quoted(tensor.name) + ":{\"dtype\":" + quoted(tensor.dtype) +
                ",\"shape\":" + shape_of(tensor) + ",\"data_offsets\":[" + std::to_string(at) + "," +
                std::to_string(end) + "]}";
        at = end;
    }
    text += "}";
    return text + std::string((8 - text.size() % 8) % 8, ' ');
}

[[noreturn]] void refuse_file(const std::string& path, const std::string& why) {
    throw Error{TORCHELEV_BAD_FILE, path + ": " + why};
}

// Name the first setting that differs.
std::string difference(const std::string& ours, const std::string& theirs) {
    size_t line = 0, k = 0;
    while (k < ours.size() && k < theirs.size() && ours[k] == theirs[k])
        if (ours[k++] == '\n') line = k;
    auto take = [&](const std::string& text) { return text.substr(line, text.find('\n', line) - line); };
    return "\"" + take(theirs) + "\" instead of \"" + take(ours) + "\"";
}

void write_all(const torchelev_map& map, std::FILE* file, const std::string& path) {
    const std::string header = header_of(map);
    const uint64_t length = header.size();
    unsigned char bytes[8];
    for (int k = 0; k < 8; k++) bytes[k] = static_cast<unsigned char>(length >> (8 * k));
    bool fits = std::fwrite(bytes, 1, 8, file) == 8 && std::fwrite(header.data(), 1, length, file) == length;
    for (const Stored& tensor : map.stored)
        fits = fits && std::fwrite(tensor.data, 1, tensor.bytes(), file) == tensor.bytes();
    if (!fits || std::fflush(file) != 0)
        refuse_file(path, std::string("cannot be written (") + std::strerror(errno) + ")");
}

// A tensor of a file whose values no update would leave behind.
bool is_sound(const Stored& tensor, const unsigned char* values) {
    const std::string dtype = tensor.dtype;
    for (int64_t k = 0; k < tensor.count(); k++) {
        float value;
        if (dtype == "BOOL" && values[k] > 1) return false;
        if (dtype != "F32") continue;
        std::memcpy(&value, values + 4 * k, 4);
        if (!std::isfinite(value) && !(tensor.has_infinities && value == -INFINITY)) return false;
    }
    return true;
}

// Whether the window lies where poses may be, and the clock has not run for ever.
bool has_sound_place(const torchelev_map& map, const unsigned char* data) {
    const double farthest = 1.1 * double(map.settings.measure.farthest) / map.resolution();
    for (size_t k = 0; k < map.stored.size(); data += map.stored[k++].bytes()) {
        int64_t numbers[2] = {};
        const std::string name = map.stored[k].name;
        const bool is_corner = name == "corner" || name == "levels_corner";
        if (!is_corner && name != "elapsed") continue;
        std::memcpy(numbers, data, map.stored[k].bytes());
        const bool is_far = std::fabs(double(numbers[0])) > farthest || std::fabs(double(numbers[1])) > farthest;
        if (is_corner ? is_far : numbers[0] < 0 || numbers[0] > INT64_MAX / 2) return false;
    }
    return true;
}

}  // namespace

std::string read_file(const std::string& path) {
    const File file(std::fopen(path.c_str(), "rb"), std::fclose);
    if (!file) refuse_file(path, std::string("cannot be read (") + std::strerror(errno) + ")");
    std::string text;
    char part[65536];
    for (size_t n; (n = std::fread(part, 1, sizeof part, file.get())) > 0;) text.append(part, n);
    if (std::ferror(file.get())) refuse_file(path, "cannot be read");
    return text;
}

void save_state(const torchelev_map& map, const std::string& path) {
    const std::unique_ptr<char, decltype(&std::free)> linked(realpath(path.c_str(), nullptr), &std::free);
    const std::string target = linked ? linked.get() : path;  // of a link, what it points to is replaced
    std::string unfinished = target + ".XXXXXX";
    const int number = mkstemp(unfinished.data());
    if (number < 0) refuse_file(path, std::string("cannot be written (") + std::strerror(errno) + ")");
    try {
        File file(fdopen(number, "wb"), std::fclose);
        if (!file) refuse_file(path, std::string("cannot be written (") + std::strerror(errno) + ")");
        fchmod(number, 0644);
        write_all(map, file.get(), path);
        const bool is_safe = fsync(number) == 0;  // before the old file goes
        if (std::fclose(file.release()) != 0 || !is_safe || std::rename(unfinished.c_str(), target.c_str()) != 0)
            refuse_file(path, std::string("cannot be written (") + std::strerror(errno) + ")");
    } catch (...) {
        std::remove(unfinished.c_str());
        throw;
    }
}

void load_state(torchelev_map& map, const std::string& path) {
    const std::string text = read_file(path);
    uint64_t length = 0;
    for (int k = 0; k < 8 && text.size() >= 8; k++) length |= uint64_t(static_cast<unsigned char>(text[k])) << (8 * k);
    if (text.size() < 8 || length > LONGEST || length > text.size() - 8)
        refuse_file(path, "no file of safetensors, or damaged");
    const Json root = JsonReader::read(text.substr(8, length), path);
    const Json* data = root.find("__metadata__");
    auto is = [&](const char* name, const std::string& wanted) {
        const Json* found = data ? data->find(name) : nullptr;
        return found && found->text == wanted;
    };
    if (!is("format", FORMAT)) refuse_file(path, "no map; write it with torchelev_map_save");
    if (!is("version", VERSION)) refuse_file(path, "of another version; read it with a newer torchelev");
    const Json* config = data->find("config");
    const std::string theirs = config ? config->text : "", ours = map.cfg.canonical();
    if (theirs != ours)
        refuse_file(path,
                    "the map of another config, " + difference(ours, theirs) + "; create the map with its config");
    // With the same config, the header of a whole file is the one that this map would write.
    if (text.substr(8, length) != header_of(map)) refuse_file(path, "damaged: its header does not describe a map");
    size_t at = 8 + length, end = at;
    for (const Stored& tensor : map.stored) end += tensor.bytes();
    if (text.size() != end)
        refuse_file(path, "damaged: " + std::to_string(text.size()) + " bytes instead of " + std::to_string(end));
    const auto* bytes = reinterpret_cast<const unsigned char*>(text.data());
    for (const Stored& tensor : map.stored) {
        if (!is_sound(tensor, bytes + at))
            refuse_file(path, std::string("damaged: ") + tensor.name + " holds what no update leaves");
        at += tensor.bytes();
    }
    at = 8 + length;
    if (!has_sound_place(map, bytes + at)) refuse_file(path, "damaged: its window or its clock cannot be");
    for (const Stored& tensor : map.stored) std::memcpy(tensor.data, bytes + at, tensor.bytes()), at += tensor.bytes();
    map.history.forget(), map.filters.forget();
}
