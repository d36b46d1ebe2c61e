// The exception that the runtime throws.
#pragma once

#include <stdexcept>

namespace nma {

// The message says what is wrong with a file, where, and what to do about it.
struct Error : std::runtime_error {
    using std::runtime_error::runtime_error;
};

}  // namespace nma
