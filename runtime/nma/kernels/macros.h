// Attributes by which a function is compiled for an instruction set that the rest of the program need not have.
#pragma once

#if defined(__clang__)
#define NMA_UNROLL _Pragma("unroll")
#elif defined(__GNUC__)
#define NMA_UNROLL _Pragma("GCC unroll 32")
#else
#define NMA_UNROLL
#endif

#if defined(__GNUC__)
#define NMA_TARGET(features) __attribute__((target(features)))
#define NMA_INLINE inline __attribute__((always_inline))
// What such a function calls becomes part of it, and so is compiled for its instruction set.
#define NMA_WHOLE __attribute__((flatten))
#else
#define NMA_TARGET(features)
#define NMA_INLINE __forceinline
#define NMA_WHOLE
#endif
