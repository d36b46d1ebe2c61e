// `Adapter::prepare` for each instruction set, chosen at run time: one binary serves all CPUs.
//
// Every instruction set compiles the same code, kernels/body.inl, over its own vector type; avx512_bf16 has a product
// of its own, which rounds weights and activations to bfloat16. For compilers that fail on it (clang 16 does at -O1),
// the macro NMA_NO_AVX512_BF16 leaves it out; NMA_PORTABLE_ONLY leaves out all but portable code.
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

// In the order of their speed.
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
// What CPU and operating system have, by the bits of leaves 1 and 7 and of the extended control register.
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

// Whether this program, on this CPU, can run it.
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

// The fastest one here that computes in float32.
inline InstructionSet fastest() {
    for (const auto set : {InstructionSet::avx512, InstructionSet::avx2, InstructionSet::neon})
        if (supported(set)) return set;
    return InstructionSet::portable;
}

// The functions of an instruction set.
struct Kernels {
    InstructionSet set;
    // One query: `inputs` padded with zeros to a multiple of INPUT_STEP, room for the last layer's width in `outputs`.
    void (*forward)(const NetworkView&, const float* inputs, float* outputs);
    // Many: rows of `inputs` padded likewise, rows of the last layer's width in `outputs`.
    void (*forward_many)(const NetworkView&, int queries, const float* inputs, int input_stride, float* outputs,
                         int output_stride);
    // What comes before the network and after it, `raw` aligned to 64 bytes. CPUs that run their widest vectors on
    // fewer units run `odds`, whose vectors are narrow, at half its speed among them: batches keep the two apart.
    void (*encode)(const Recipe&, const float* parameters, const Vec3<float>& wi, float* inputs);
    void (*decode)(const Recipe&, float* raw, float cosine, Blend<float>&);
    void (*odds)(const Recipe&, float cosine, Blend<float>&);
    // All of it for one query.
    void (*prepare)(const Recipe&, const float* parameters, const Vec3<float>& wi, Blend<float>&);
};

// Those of `set`; the portable ones if it cannot run here.
inline const Kernels& kernels(InstructionSet set) {
    static constexpr Kernels PORTABLE{InstructionSet::portable,
                                      portable::forward,
                                      portable::forward_many,
                                      portable::encode,
                                      portable::decode,
                                      portable::odds,
                                      portable::prepare<portable::forward>};
    if (!supported(set)) return PORTABLE;
#if defined(NMA_X86)
    static constexpr Kernels AVX2{InstructionSet::avx2, avx2::forward, avx2::forward_many,          avx2::encode,
                                  avx2::decode,         avx2::odds,    avx2::prepare<avx2::forward>};
    static constexpr Kernels AVX512{InstructionSet::avx512, avx512::forward_narrow, avx512::forward_many,
                                    avx512::encode,         avx512::decode,         avx512::odds,
                                    avx512::prepare_either};
#if !defined(NMA_NO_AVX512_BF16)
    static constexpr Kernels BF16{InstructionSet::avx512_bf16,
                                  avx512_bf16::forward,
                                  avx512_bf16::forward_many,
                                  avx512::encode,
                                  avx512::decode,
                                  avx512::odds,
                                  avx512::prepare<avx512_bf16::forward>};
    if (set == InstructionSet::avx512_bf16) return BF16;
#endif
    if (set == InstructionSet::avx2) return AVX2;
    if (set == InstructionSet::avx512) return AVX512;
#elif defined(NMA_ARM)
    static constexpr Kernels NEON{InstructionSet::neon, neon::forward, neon::forward_many,          neon::encode,
                                  neon::decode,         neon::odds,    neon::prepare<neon::forward>};
    if (set == InstructionSet::neon) return NEON;
#endif
    return PORTABLE;
}

}  // namespace nma
