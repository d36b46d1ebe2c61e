// The exception that the runtime throws.
#pragma once

#include <stdexcept>
#include <string>
#include <string_view>

namespace nma {

// The message of this exception says what is wrong, where the fault is in the weights file, and how to repair it.
struct Error : std::runtime_error {
    using std::runtime_error::runtime_error;
};

// A name from a file for an error message: shortened, and with `?` in place of control characters, so that the message
// stays one line.
inline std::string shown(std::string_view name) {
    constexpr std::size_t LONGEST = 60;
    std::string text(name.substr(0, LONGEST));
    for (char& c : text)
        if (static_cast<unsigned char>(c) < 0x20 || c == 0x7F) c = '?';
    return name.size() > LONGEST ? text + "..." : text;
}

}  // namespace nma
