// Damages configs, layouts and saved maps at random and reads them: `python -m benchmarks.runtime sanitize`. Nothing
// but an error may come of it; the sanitizers that it is built with watch.
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <random>
#include <sstream>
#include <torchelev.hpp>

namespace {

std::mt19937 generator;

size_t below(size_t number) { return number ? generator() % number : 0; }

const char* const TOKENS[] = {"null",        "true",         "-1",      "0",  "1e999", "-0.0", "\"inf\"",
                              "1e-320",      "2147483648",   "{",       "}",  "[",     "]",    ",",
                              ":",           "\"",           "\\u0041", "\\", "0.1",   "255",  "\"grid\"",
                              "\"filters\"", "9999999999999"};

std::string damaged(std::string text) {
    for (size_t k = 1 + below(3); k > 0 && !text.empty(); k--) {
        const size_t at = below(text.size()), length = 1 + below(12);
        const bool is_digit = text[at] >= '0' && text[at] <= '9';
        switch (is_digit ? 5 : below(5)) {
            case 5:
                text[at] = char('0' + below(10));
                break;
            case 0:
                text[at] = char(generator());
                break;
            case 1:
                text.erase(at, length);
                break;
            case 2:
                text.insert(at, TOKENS[below(std::size(TOKENS))]);
                break;
            case 3:
                text.insert(at, text.substr(below(text.size()), length));
                break;
            default:
                text.replace(at, std::min(length, text.size() - at), TOKENS[below(std::size(TOKENS))]);
        }
    }
    return text;
}

std::string read(const std::string& path) {
    std::ifstream file(path, std::ios::binary);
    std::stringstream text;
    text << file.rdbuf();
    return text.str();
}

void update(torchelev_map* map) {
    float points[300];
    for (float& value : points) value = float(below(4000)) / 1000 - 2;
    const torchelev::Pose T{1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0.5, 0, 0, 0, 1};
    const torchelev_input input{1, 100, points, T.data(), T.data(), nullptr, 0.1, nullptr, nullptr};
    std::vector<double> links;
    for (int k = 0; k < torchelev_map_num_links(map); k++) links.insert(links.end(), T.begin(), T.end());
    torchelev_input with_links = input;
    if (!links.empty()) with_links.T_base_links = links.data();
    torchelev_map_update(map, &with_links);
}

// Update a map, and read the layers of its filters and its diagnosis.
void use(torchelev_map* map) {
    update(map);
    int64_t rows, columns;
    torchelev_map_size(map, &rows, &columns, nullptr);
    std::vector<float> values(size_t(rows * columns));
    for (const char* layer : {"smooth", "nearest", "lowest", "harmonic"})
        torchelev_map_layer(map, layer, values.data(), values.size());
    const char* findings;
    torchelev_map_diagnose(map, &findings);
}

// Create and read an image; return whether its settings were good.
bool read_image(const torchelev_map* map, const std::string& settings) {
    const torchelev::Pose T{1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0.5, 0, 0, 0, 1};
    torchelev_image* image = nullptr;
    int64_t shape[3];
    const bool is_good = !torchelev_image_create(map, settings.c_str(), &image);
    if (is_good && !torchelev_image_shape(image, shape)) {
        std::vector<float> values(size_t(shape[0] * shape[1] * shape[2]));
        torchelev_image_read(image, map, T.data(), values.data());
    }
    torchelev_image_free(image);
    return is_good;
}

// Whether a config may ask for a large grid, which may be more than there is memory for.
bool is_large(const std::string& config) { return config.find("\"grid\": {\"resolution\": 0.1,") == std::string::npos; }

}  // namespace

int main(int count, char** arguments) {
    if (count != 4) return std::fprintf(stderr, "usage: %s map.json folder seconds\n", arguments[0]), 2;
    const std::string config = read(arguments[1]), path = std::string(arguments[2]) + "/map.safetensors";
    const std::string layout =
        "{\"pattern\": [[0.3, 0.2], [-0.4, 0.1]], \"fill\": \"inpaint\", \"clip\": 1.0, \"original\": \"-inf\", "
        "\"num_feet\": 0}";
    const std::string image =
        "{\"length_x\": 1.0, \"length_y\": 0.8, \"resolution\": 0.1, \"offset\": [0.1, 0.0], \"mode\": \"bilinear\", "
        "\"layers\": [\"elevation\", \"validity\", \"variance\"], \"nominal_height\": 0.3}";
    const torchelev_limits limits{200, 1, 1};
    torchelev_map* map = nullptr;
    if (torchelev_map_create_from_text(config.c_str(), &limits, &map))
        return std::fprintf(stderr, "%s\n", torchelev_last_error()), 1;
    update(map);
    if (torchelev_map_save(map, path.c_str())) return std::fprintf(stderr, "%s\n", torchelev_last_error()), 1;
    const std::string saved = read(path);
    long tries = 0, good[4] = {};
    const auto end = std::chrono::steady_clock::now() + std::chrono::seconds(std::atoi(arguments[3]));
    for (; std::chrono::steady_clock::now() < end; tries++) {
        torchelev_map* other = nullptr;
        const std::string text = damaged(config);
        if (!is_large(text) && !torchelev_map_create_from_text(text.c_str(), &limits, &other)) good[0]++, use(other);
        torchelev_map_free(other);
        torchelev_scan* scan = nullptr;
        const torchelev::Pose T{1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0.5, 0, 0, 0, 1};
        if (!torchelev_scan_create(map, damaged(layout).c_str(), &scan)) {
            std::vector<float> values(size_t(torchelev_scan_size(scan)));
            good[1] += !torchelev_scan_read(scan, map, T.data(), nullptr, values.data(), nullptr);
        }
        torchelev_scan_free(scan);
        std::ofstream(path, std::ios::binary) << damaged(saved);
        good[2] += !torchelev_map_load(map, path.c_str());
        use(map);
        good[3] += read_image(map, damaged(image));
    }
    torchelev_map_free(map);
    std::printf("%ld of each: read %ld configs, %ld layouts, %ld saved maps, %ld images\n", tries, good[0], good[1],
                good[2], good[3]);
}
