// Attributes that compile a single function for an instruction set, such as AVX2, that the rest of the program need not
// use.
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
// Inlines all functions that the function calls, so that they are compiled for the same instruction set.
#define NMA_WHOLE __attribute__((flatten))
#else
#define NMA_TARGET(features)
#define NMA_INLINE __forceinline
#define NMA_WHOLE
#endif
