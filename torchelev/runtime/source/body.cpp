// The shapes of a robot's links in a config, and their rules: shapes.py.

#include <algorithm>
#include <initializer_list>

#include "runtime/source/config.h"

namespace {

// Names that a shape or a body may have.
void require_names(const Json& value, const std::string& where, std::initializer_list<const char*> names) {
    REQUIRE(value.kind == Json::OBJECT, where, "must be a mapping", value.type(), "see ElevationMapConfig");
    for (const auto& [name, part] : value.members) {
        const bool is_known = std::find(names.begin(), names.end(), name) != names.end();
        REQUIRE(is_known, where + "." + name, "is not a setting", "'" + name + "'", "there are " + joined(names));
    }
}

// A member as an error shows it; all numbers of shapes are floats.
std::string shown(const Json* value) {
    if (!value) return "none";
    return value->kind == Json::NUMBER ? repr(value->number) : value->describe();
}

// Finite numbers of a member, which must be there.
std::vector<double> numbers(const Json& shape, const std::string& where, const char* name, size_t size,
                            const char* hint) {
    const Json* value = shape.find(name);
    std::vector<double> found;
    bool fits = value && value->kind == Json::ARRAY && value->items.size() == size;
    for (size_t k = 0; fits && k < size; k++) {
        fits = value->items[k].kind == Json::NUMBER && std::isfinite(value->items[k].number);
        found.push_back(value->items[k].number);
    }
    REQUIRE(fits, where + "." + name, "must be " + std::to_string(size) + " finite numbers", shown(value), hint);
    return found;
}

double positive(const Json& shape, const std::string& where, const char* name) {
    const Json* value = shape.find(name);
    const bool fits = value && value->kind == Json::NUMBER && value->number > 0 && std::isfinite(value->number);
    REQUIRE(fits, where + "." + name, "must be a positive number", shown(value), "give metres");
    return value->number;
}

double not_negative(const Json& body, const char* name, double usual) {
    const Json* value = body.find(name);
    if (!value) return usual;
    const bool fits = value->kind == Json::NUMBER && value->number >= 0 && std::isfinite(value->number);
    REQUIRE(fits, std::string("body.") + name, "must be finite and not negative", shown(value),
            "give metres, such as 0.003");
    return value->number;
}

const std::vector<Json>& shapes_of(const Json& body, const char* name) {
    static const std::vector<Json> none;
    const Json* value = body.find(name);
    if (!value) return none;
    REQUIRE(value->kind == Json::ARRAY, std::string("config.sensor.body.") + name, "must be a list", value->type(),
            "begin lines with -");
    return value->items;
}

}  // namespace

RobotBody::RobotBody(const Json& body) {
    require_names(body, "config.sensor.body", {"capsules", "boxes", "padding", "depth_tolerance"});
    padding = not_negative(body, "padding", 0.003), depth_tolerance = not_negative(body, "depth_tolerance", 0.03);
    text = "sensor.body " + repr(padding) + " " + repr(depth_tolerance) + "\n";
    for (const Json& capsule : shapes_of(body, "capsules")) add_capsule(capsule);
    for (const Json& box : shapes_of(body, "boxes")) add_box(box);
    REQUIRE(!capsules.empty() || !boxes.empty(), "body", "must have a capsule or a box", "none",
            "give shapes, or body=None for no body");
}

robot_body::Body RobotBody::packed() const {
    return {capsules.data(), boxes.data(), int64_t(capsules.size()), int64_t(boxes.size()), float(depth_tolerance)};
}

// The number of a shape's link; links are numbered in the order in which shapes name them, capsules first.
int RobotBody::link_of(const Json& shape, const std::string& where) {
    const Json* link = shape.find("link");
    bool fits = link && link->kind == Json::STRING && !link->text.empty();
    for (size_t k = 0; fits && k < link->text.size(); k++) fits = static_cast<unsigned char>(link->text[k]) >= 0x20;
    REQUIRE(fits, where + ".link", "must be the name of a link", shown(link),
            "give the link that the shape is fixed to");
    const auto found = std::find(links.begin(), links.end(), link->text);
    const int number = int(found - links.begin());
    if (found == links.end()) links.push_back(link->text);
    text += "sensor.body " + where + " " + link->text;
    return number;
}

void RobotBody::add_capsule(const Json& capsule) {
    require_names(capsule, "config.sensor.body.capsules[" + std::to_string(capsules.size()) + "]",
                  {"link", "start", "end", "radius"});
    robot_body::Capsule packed{};
    packed.link = float(link_of(capsule, "capsule"));
    const double radius = positive(capsule, "capsule", "radius");
    const std::vector<double> start = numbers(capsule, "capsule", "start", 3, "give metres");
    const std::vector<double> end = numbers(capsule, "capsule", "end", 3, "give metres");
    double squared = 0;
    for (int k = 0; k < 3; k++) {
        packed.start[k] = float(start[k]), packed.axis[k] = float(end[k] - start[k]);
        squared += (end[k] - start[k]) * (end[k] - start[k]);
        text += " " + repr(start[k]) + " " + repr(end[k]);
    }
    packed.squared = float(squared), packed.limit = float((radius + padding) * (radius + padding));
    text += " " + repr(radius) + "\n";
    capsules.push_back(packed);
}

void RobotBody::add_box(const Json& box) {
    require_names(box, "config.sensor.body.boxes[" + std::to_string(boxes.size()) + "]",
                  {"link", "center", "half_lengths", "quat_wxyz"});
    robot_body::Box packed{};
    packed.link = float(link_of(box, "box"));
    const std::vector<double> center = numbers(box, "box", "center", 3, "give metres");
    const std::vector<double> half = numbers(box, "box", "half_lengths", 3, "give metres");
    std::vector<double> q{1, 0, 0, 0};
    if (box.find("quat_wxyz")) q = numbers(box, "box", "quat_wxyz", 4, "give w, x, y, z");
    REQUIRE(*std::min_element(half.begin(), half.end()) > 0, "box.half_lengths", "must be positive",
            "(" + repr(half[0]) + ", " + repr(half[1]) + ", " + repr(half[2]) + ")",
            "give half the side lengths in metres");
    const double w = q[0], x = q[1], y = q[2], z = q[3], norm = std::sqrt(w * w + x * x + y * y + z * z);
    REQUIRE(std::fabs(norm - 1) < 1e-3, "box.quat_wxyz", "must have norm 1", general(norm), "divide it by its norm");
    const double rows[] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z),     2 * (x * z + w * y),
                           2 * (x * y + w * z),     1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                           2 * (x * z - w * y),     2 * (y * z + w * x),     1 - 2 * (x * x + y * y)};
    std::copy(std::begin(rows), std::end(rows), packed.rotation);
    for (int k = 0; k < 3; k++) {
        packed.center[k] = float(center[k]), packed.half[k] = float(half[k] + padding);
        text += " " + repr(center[k]) + " " + repr(half[k]);
    }
    for (const double part : q) text += " " + repr(part);
    text += "\n";
    boxes.push_back(packed);
}
