// The exception that the runtime throws.
#pragma once

#include <stdexcept>

namespace nma {

// The message of this exception says what is wrong, where the fault is in the weights file, and how to repair it.
struct Error : std::runtime_error {
    using std::runtime_error::runtime_error;
};

}  // namespace nma
