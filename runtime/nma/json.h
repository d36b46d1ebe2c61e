// A strict reader for JSON (RFC 8259), with the features that weights files need. The reader returns a tree of values
// of limited depth.
//
// An object stores its names and its items in two vectors. One vector of pairs is not possible, because std::pair,
// unlike std::vector, must not contain the type `Json` before that type is complete.
#pragma once

#include <algorithm>
#include <cstdint>
#include <locale>
#include <sstream>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "error.h"
#include "generated/constants.h"

namespace nma {

struct Json {
    enum class Kind { Null, Boolean, Number, String, Array, Object };

    Kind kind = Kind::Null;
    bool boolean = false;
    double number = 0.0;
    bool whole = false;  // whether the number is written without a point and without an exponent
    std::string string;
    std::vector<Json> items;         // the items of an array or of an object, in order
    std::vector<std::string> names;  // the names of an object's items, in the same order

    // The item called `name`, or null if there is no such item.
    const Json* find(std::string_view name) const {
        for (std::size_t k = 0; k < names.size(); ++k)
            if (names[k] == name) return &items[k];
        return nullptr;
    }

    // The item called `name`. Throws unless this item exists and is of the expected kind.
    const Json& at(std::string_view name, Kind expected) const {
        const Json* found = find(name);
        if (!found || found->kind != expected) throw Error("the metadata lacks a valid '" + std::string(name) + "'");
        return *found;
    }

    static Json parse(std::string_view text);
};

namespace detail {

class JsonParser {
public:
    explicit JsonParser(std::string_view text) : text_(text) {}

    Json document() {
        Json value = this->value(0);
        space();
        if (place_ != text_.size()) fail("text after the end");
        return value;
    }

private:
    [[noreturn]] void fail(const char* what) const {
        throw Error("malformed JSON at byte " + std::to_string(place_) + ": " + what);
    }

    char peek() const { return place_ < text_.size() ? text_[place_] : '\0'; }

    void space() {
        while (place_ < text_.size() && std::string_view(" \t\r\n").find(text_[place_]) != std::string_view::npos)
            ++place_;
    }

    bool take(std::string_view word) {
        if (text_.substr(place_, word.size()) != word) return false;
        place_ += word.size();
        return true;
    }

    void expect(std::string_view word) {
        if (!take(word)) fail(("'" + std::string(word) + "' was expected").c_str());
    }

    Json value(int depth) {
        space();
        Json made;
        switch (peek()) {
            case '{':
                made.kind = Json::Kind::Object;
                fields(made, deeper(depth));
                break;
            case '[':
                made.kind = Json::Kind::Array;
                items(made, deeper(depth));
                break;
            case '"':
                made.kind = Json::Kind::String;
                made.string = string();
                break;
            case 't':
                expect("true");
                made.kind = Json::Kind::Boolean;
                made.boolean = true;
                break;
            case 'f':
                expect("false");
                made.kind = Json::Kind::Boolean;
                break;
            case 'n':
                expect("null");
                break;
            default:
                made.kind = Json::Kind::Number;
                made.number = number(made.whole);
        }
        return made;
    }

    int deeper(int depth) const {
        if (depth == MAX_DEPTH) fail("nested too deep");
        return depth + 1;
    }

    void fields(Json& made, int depth) {
        expect("{");
        space();
        if (take("}")) return;
        do {
            space();
            std::string key = string();
            space();
            expect(":");
            made.names.push_back(std::move(key));
            made.items.push_back(value(depth));
            space();
        } while (take(","));
        expect("}");
        refuse_twins(made.names);
    }

    // Throws if a key occurs twice, because readers would differ in which of the two values they take.
    static void refuse_twins(std::vector<std::string> keys) {
        std::sort(keys.begin(), keys.end());
        const auto twin = std::adjacent_find(keys.begin(), keys.end());
        if (twin != keys.end())
            throw Error("the header has the key '" + shown(*twin) + "' twice; copy the file again or train again");
    }

    void items(Json& made, int depth) {
        expect("[");
        space();
        if (take("]")) return;
        do {
            made.items.push_back(value(depth));
            space();
        } while (take(","));
        expect("]");
    }

    // Reads a number by JSON's grammar, which is stricter than that of streams.
    double number(bool& whole) {
        const std::size_t first = place_;
        take("-");
        if (!take("0")) digits();
        whole = true;
        if (take(".")) {
            digits();
            whole = false;
        }
        if (take("e") || take("E")) {
            if (!take("+")) take("-");
            digits();
            whole = false;
        }
        // A stream with the classic locale reads "." as the decimal point, whereas strtod would use the locale of the
        // host program.
        std::istringstream text(std::string(text_.substr(first, place_ - first)));
        text.imbue(std::locale::classic());
        double found = 0.0;
        if (!(text >> found)) fail("not a number");
        return found;
    }

    void digits() {
        const std::size_t first = place_;
        while (peek() >= '0' && peek() <= '9') ++place_;
        if (place_ == first) fail("not a number");
    }

    std::string string() {
        expect("\"");
        std::string made;
        while (peek() != '"') {
            if (place_ >= text_.size()) fail("a string without an end");
            const char c = text_[place_++];
            if (static_cast<unsigned char>(c) < 0x20) fail("a control character in a string");
            if (c == '\\') escape(made);
            else made.push_back(c);
        }
        ++place_;
        return made;
    }

    void escape(std::string& made) {
        const char c = peek();
        ++place_;
        const auto found = std::string_view("\"\\/bfnrt").find(c);
        if (found != std::string_view::npos && c != '\0') made.push_back("\"\\/\b\f\n\r\t"[found]);
        else if (c == 'u') made += utf8(hex());
        else fail("an unknown escape");
    }

    std::uint32_t hex() {
        std::uint32_t code = 0;
        for (int k = 0; k < 4; ++k, ++place_) {
            const auto digit = std::string_view("0123456789abcdefABCDEF").find(peek());
            if (digit == std::string_view::npos) fail("not four hexadecimal digits");
            code = 16 * code + static_cast<std::uint32_t>(digit < 16 ? digit : digit - 6);
        }
        return code;
    }

    // A UTF-16 code unit as UTF-8. The two halves of a surrogate pair are not joined, because no field that the runtime
    // reads has surrogate pairs.
    static std::string utf8(std::uint32_t code) {
        const auto tail = [](std::uint32_t bits) { return static_cast<char>(0x80 | (bits & 0x3F)); };
        if (code < 0x80) return {static_cast<char>(code)};
        if (code < 0x800) return {static_cast<char>(0xC0 | (code >> 6)), tail(code)};
        return {static_cast<char>(0xE0 | (code >> 12)), tail(code >> 6), tail(code)};
    }

    std::string_view text_;
    std::size_t place_ = 0;
};

}  // namespace detail

inline Json Json::parse(std::string_view text) { return detail::JsonParser(text).document(); }

}  // namespace nma
