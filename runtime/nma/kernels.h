// The functions of `Adapter::prepare` for each instruction set. The instruction set is chosen at run time, so one
// binary runs on all CPUs.
//
// The code in kernels/body.inl is compiled for the vector type of each instruction set. Only avx512_bf16 has its own
// code for the network (kernels/avx512_bf16.h), which rounds weights and activations to bfloat16. The macro
// NMA_NO_AVX512_BF16 leaves out avx512_bf16.h, on which some compilers crash, such as clang 16 at -O1. The macro
// NMA_PORTABLE_ONLY leaves out the code of all instruction sets except `portable`.
#pragma once

#include <cstdint>
#include <string>

#include "kernels/portable.h"
#if (defined(__x86_64__) || defined(_M_X64)) && !defined(NMA_PORTABLE_ONLY)
#include "kernels/avx2.h"
#include "kernels/avx512.h"
#if !defined(NMA_NO_AVX512_BF16)
#include "kernels/avx512_bf16.h"
#endif
#define NMA_X86 1
#if defined(_MSC_VER)
#include <intrin.h>
#endif
#elif defined(__aarch64__) && !defined(NMA_PORTABLE_ONLY)
#include "kernels/neon.h"
#define NMA_ARM 1
#endif

namespace nma {

// The instruction sets, from the slowest to the fastest.
enum class InstructionSet { portable, neon, avx2, avx512, avx512_bf16 };

constexpr InstructionSet INSTRUCTION_SETS[] = {InstructionSet::portable, InstructionSet::neon, InstructionSet::avx2,
                                               InstructionSet::avx512, InstructionSet::avx512_bf16};

inline const char* name(InstructionSet set) {
    constexpr const char* NAMES[] = {"portable", "neon", "avx2", "avx512", "avx512_bf16"};
    return NAMES[static_cast<int>(set)];
}

namespace detail {

#ifdef NMA_X86
#if defined(_MSC_VER)
// Whether the CPU and the operating system support `set`. Leaves 1 and 7 of CPUID tell what the CPU supports, and the
// extended control register tells what the operating system supports.
inline bool cpu_has(InstructionSet set) {
    int leaf1[4], leaf7[4], leaf7_1[4];
    __cpuid(leaf1, 1);
    if (!(leaf1[2] >> 27 & 1) || !(leaf1[2] >> 12 & 1)) return false;
    const unsigned long long state = _xgetbv(0);
    __cpuidex(leaf7, 7, 0);
    __cpuidex(leaf7_1, 7, 1);
    const bool avx2 = (state & 0x6) == 0x6 && (leaf7[1] >> 5 & 1);
    const bool avx512 = (state & 0xe6) == 0xe6 && (leaf7[1] >> 16 & 1) && (leaf7[1] >> 17 & 1) &&
                        (leaf7[1] >> 30 & 1) && (leaf7[1] >> 31 & 1);
    if (set == InstructionSet::avx2) return avx2;
    return avx512 && (set == InstructionSet::avx512 || (leaf7_1[0] >> 5 & 1));
}
#else
inline bool cpu_has(InstructionSet set) {
    const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
    const bool avx512 = avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
                        __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl");
    if (set == InstructionSet::avx2) return avx2;
    return avx512 && (set == InstructionSet::avx512 || __builtin_cpu_supports("avx512bf16"));
}
#endif
#endif

}  // namespace detail

// Whether this program can run `set` on this CPU.
inline bool supported(InstructionSet set) {
    if (set == InstructionSet::portable) return true;
#if defined(NMA_X86)
#if defined(NMA_NO_AVX512_BF16)
    if (set == InstructionSet::avx512_bf16) return false;
#endif
    return set != InstructionSet::neon && detail::cpu_has(set);
#elif defined(NMA_ARM)
    return set == InstructionSet::neon;
#else
    return false;
#endif
}

// The fastest supported instruction set that computes in float32.
inline InstructionSet fastest() {
    for (const auto set : {InstructionSet::avx512, InstructionSet::avx2, InstructionSet::neon})
        if (supported(set)) return set;
    return InstructionSet::portable;
}

// The kernels of one instruction set: the functions that are compiled for this set and called through a pointer. The
// inputs of a query are a row of floats, filled with zeros up to the padded input count of the first layer. The outputs
// of a query are a row whose length is the padded width of the last layer, aligned to 64 bytes.
struct Kernels {
    InstructionSet set;
    int lanes;  // of its vectors
    // Runs the network for one query.
    void (*forward)(const NetworkView&, const float* inputs, float* outputs);
    // Runs the network for many queries, each of which has a row of inputs and a row of outputs.
    void (*forward_many)(const NetworkView&, int queries, const float* inputs, int input_stride, float* outputs,
                         int output_stride);
    // `encode` fills in a row of inputs. `decode` computes a blend from `raw`, a row of outputs, and overwrites `raw`.
    // From `parameters`, `decode` reads only the interface above the blend, if there is one.
    // `set_lobe_probabilities` then completes the blend: it fills in the lobe probabilities and, if the adapter is
    // bounded, the factor `scale`. `decode` uses wide vectors, and `set_lobe_probabilities` uses
    // narrow vectors. Some CPUs run narrow vector instructions at half the speed while wide vector instructions are
    // running. So `prepare_many` calls `decode` for all queries of a block before it calls `set_lobe_probabilities`.
    void (*encode)(const Preparation&, const float* parameters, const Vec3<float>& wi, float* inputs);
    void (*decode)(const Preparation&, const float* parameters, float* raw, float cosine, Blend<float>&);
    void (*set_lobe_probabilities)(const Preparation&, float cosine, Blend<float>&);
    // Runs all steps for one query.
    void (*prepare)(const Preparation&, const float* parameters, const Vec3<float>& wi, Blend<float>&);
};

// The functions for `set`, or the portable functions if this CPU does not support `set`.
inline const Kernels& kernels(InstructionSet set) {
    static constexpr Kernels PORTABLE{InstructionSet::portable,
                                      portable::VEC_SIZE,
                                      portable::forward,
                                      portable::forward_many,
                                      portable::encode,
                                      portable::decode,
                                      portable::set_lobe_probabilities,
                                      portable::prepare<portable::forward>};
    if (!supported(set)) return PORTABLE;
#if defined(NMA_X86)
    static constexpr Kernels AVX2{InstructionSet::avx2,
                                  avx2::VEC_SIZE,
                                  avx2::forward,
                                  avx2::forward_many,
                                  avx2::encode,
                                  avx2::decode,
                                  avx2::set_lobe_probabilities,
                                  avx2::prepare<avx2::forward>};
    static constexpr Kernels AVX512{InstructionSet::avx512,         avx512::VEC_SIZE,   avx512::forward_any,
                                    avx512::forward_many,           avx512::encode,     avx512::decode,
                                    avx512::set_lobe_probabilities, avx512::prepare_any};
#if !defined(NMA_NO_AVX512_BF16)
    static constexpr Kernels BF16{InstructionSet::avx512_bf16,
                                  avx512_bf16::VEC_SIZE,
                                  avx512_bf16::forward,
                                  avx512_bf16::forward_many,
                                  avx512::encode,
                                  avx512::decode,
                                  avx512::set_lobe_probabilities,
                                  avx512::prepare<avx512_bf16::forward>};
    if (set == InstructionSet::avx512_bf16) return BF16;
#endif
    if (set == InstructionSet::avx2) return AVX2;
    if (set == InstructionSet::avx512) return AVX512;
#elif defined(NMA_ARM)
    static constexpr Kernels NEON{InstructionSet::neon,
                                  neon::VEC_SIZE,
                                  neon::forward,
                                  neon::forward_many,
                                  neon::encode,
                                  neon::decode,
                                  neon::set_lobe_probabilities,
                                  neon::prepare<neon::forward>};
    if (set == InstructionSet::neon) return NEON;
#endif
    return PORTABLE;
}

}  // namespace nma
