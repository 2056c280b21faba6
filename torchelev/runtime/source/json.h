// A strict reader of JSON: objects, arrays, strings, numbers, true, false and null, nothing else.
#pragma once

#include <cstring>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "runtime/source/error.h"

struct Json {
    enum Kind { NUL, BOOLEAN, NUMBER, STRING, ARRAY, OBJECT } kind = NUL;
    bool is_true = false, is_whole = false;  // a number without point or exponent
    double number = 0;
    std::string text;                                   // of a string; of a number, as it was written
    std::vector<Json> items;                            // of an array
    std::vector<std::pair<std::string, Json>> members;  // of an object

    const Json* find(const std::string& name) const {
        for (const auto& [key, value] : members)
            if (key == name) return &value;
        return nullptr;
    }

    // The name of its type in Python.
    const char* type() const {
        const char* const names[] = {"NoneType", "bool", is_whole ? "int" : "float", "str", "list", "dict"};
        return names[kind];
    }

    // What an error calls it, as Python does.
    std::string describe() const {
        switch (kind) {
            case NUL:
                return "None";
            case BOOLEAN:
                return is_true ? "True" : "False";
            case NUMBER:
                return is_whole ? text : repr(number);
            case STRING:
                return "'" + text + "'";
            case ARRAY:
                return "list";
            default:
                return "dict";
        }
    }
};

class JsonReader {
    static constexpr int DEEPEST = 32;
    const std::string& source;
    const std::string where;  // the file's name
    size_t at = 0;

    [[noreturn]] void refuse(const std::string& what) const {
        size_t line = 1, column = 1;
        for (size_t k = 0; k < at && k < source.size(); k++) source[k] == '\n' ? (line++, column = 1) : column++;
        const std::string place = "line " + std::to_string(line) + ", column " + std::to_string(column);
        throw Error{TORCHELEV_BAD_FILE, where + ": cannot be read as JSON (" + what + ", " + place + ")"};
    }

    void skip_space() {
        while (at < source.size() && std::strchr(" \t\r\n", source[at]) && source[at]) at++;
    }

    bool take(char c) {
        skip_space();
        if (at >= source.size() || source[at] != c) return false;
        at++;
        return true;
    }

    bool take_word(const std::string& word) {
        if (source.compare(at, word.size(), word) != 0) return false;
        at += word.size();
        return true;
    }

    void append_utf8(std::string& text, unsigned code) const {
        if (code < 0x80) return void(text += char(code));
        if (code < 0x800) return void(text += {char(0xc0 | code >> 6), char(0x80 | (code & 63))});
        text += {char(0xe0 | code >> 12), char(0x80 | (code >> 6 & 63)), char(0x80 | (code & 63))};
    }

    unsigned read_code() {
        unsigned code = 0;
        for (int k = 0; k < 4; k++, at++) {
            const char c = at < source.size() ? source[at] : ' ';
            const int digit = c >= '0' && c <= '9'   ? c - '0'
                              : c >= 'a' && c <= 'f' ? c - 'a' + 10
                              : c >= 'A' && c <= 'F' ? c - 'A' + 10
                                                     : -1;
            if (digit < 0) refuse("a bad \\u escape");
            code = 16 * code + digit;
        }
        if (code >= 0xd800 && code < 0xe000) refuse("a surrogate, which no setting needs");
        return code;
    }

    void read_escape(std::string& text) {
        static const std::string codes = "\"\\/bfnrt", meanings = "\"\\/\b\f\n\r\t";
        const char c = at < source.size() ? source[at++] : ' ';
        const size_t k = codes.find(c);
        if (c == 'u') return append_utf8(text, read_code());
        if (k == std::string::npos) refuse("a bad escape");
        text += meanings[k];
    }

    std::string read_string() {
        std::string text;
        while (true) {
            if (at >= source.size()) refuse("a string without an end");
            const char c = source[at++];
            if (c == '"') return text;
            if (static_cast<unsigned char>(c) < 0x20) refuse("a control character in a string");
            if (c == '\\') read_escape(text);
            else text += c;
        }
    }

    size_t skip_digits() {
        const size_t first = at;
        while (at < source.size() && source[at] >= '0' && source[at] <= '9') at++;
        return at - first;
    }

    Json read_number() {
        Json value;
        value.kind = Json::NUMBER, value.is_whole = true;
        const size_t first = at;
        if (source[at] == '-') at++;
        const size_t begin = at, digits = skip_digits();
        if (digits == 0 || (digits > 1 && source[begin] == '0')) refuse("no value");
        if (at < source.size() && source[at] == '.') {
            at++, value.is_whole = false;
            if (skip_digits() == 0) refuse("no digit after the point");
        }
        if (at < source.size() && (source[at] == 'e' || source[at] == 'E')) {
            at++, value.is_whole = false;
            if (at < source.size() && (source[at] == '+' || source[at] == '-')) at++;
            if (skip_digits() == 0) refuse("no digit in the exponent");
        }
        value.text = source.substr(first, at - first);
        value.number = std::strtod(value.text.c_str(), nullptr);  // in the "C" locale, which programs rarely change
        return value;
    }

    Json read_members(int depth) {
        Json value;
        value.kind = Json::OBJECT;
        if (take('}')) return value;
        do {
            skip_space();
            if (!take('"')) refuse("no name of a member");
            std::string name = read_string();
            if (value.find(name)) refuse("'" + name + "' twice");
            if (!take(':')) refuse("no ':'");
            value.members.emplace_back(std::move(name), read(depth + 1));
        } while (take(','));
        if (!take('}')) refuse("no ',' or '}'");
        return value;
    }

    Json read_items(int depth) {
        Json value;
        value.kind = Json::ARRAY;
        if (take(']')) return value;
        do value.items.push_back(read(depth + 1));
        while (take(','));
        if (!take(']')) refuse("no ',' or ']'");
        return value;
    }

    Json read(int depth) {
        Json value;
        skip_space();
        if (depth > DEEPEST) refuse("too many levels");
        if (at >= source.size()) refuse("no value");
        if (take('{')) return read_members(depth);
        if (take('[')) return read_items(depth);
        if (take('"')) return value.kind = Json::STRING, value.text = read_string(), value;
        if (take_word("null")) return value;
        if (take_word("true")) return value.kind = Json::BOOLEAN, value.is_true = true, value;
        if (take_word("false")) return value.kind = Json::BOOLEAN, value;
        return read_number();
    }

    JsonReader(const std::string& source, const std::string& where) : source(source), where(where) {}

  public:
    // Read a whole text; errors name the file.
    static Json read(const std::string& source, const std::string& where) {
        JsonReader reader(source, where);
        Json value = reader.read(0);
        reader.skip_space();
        if (reader.at != source.size()) reader.refuse("more than one value");
        return value;
    }
};
