// AArch64, which always has NEON: four lanes, 32 registers.
#pragma once

#include <arm_neon.h>

#include "../preparation.h"
#include "macros.h"

#define NMA_FN
#define NMA_OP NMA_INLINE

namespace nma::neon {

constexpr int VEC_SIZE = 4, SINGLE_TILE = 8, BATCH_TILE = 4, BATCH_QUERIES = 6;

using Vec = float32x4_t;

NMA_OP Vec load(const float* p) { return vld1q_f32(p); }
NMA_OP void store(float* p, Vec v) { vst1q_f32(p, v); }
NMA_OP Vec set(float x) { return vdupq_n_f32(x); }
NMA_OP Vec add(Vec a, Vec b) { return vaddq_f32(a, b); }
NMA_OP Vec sub(Vec a, Vec b) { return vsubq_f32(a, b); }
NMA_OP Vec mul(Vec a, Vec b) { return vmulq_f32(a, b); }
NMA_OP Vec inverse(Vec a) { return vdivq_f32(set(1.0f), a); }
NMA_OP Vec fma(Vec a, Vec b, Vec c) { return vfmaq_f32(c, a, b); }
NMA_OP Vec max(Vec a, Vec b) { return vmaxq_f32(a, b); }
NMA_OP Vec min(Vec a, Vec b) { return vminq_f32(a, b); }
NMA_OP Vec nearest(Vec x) { return vrndnq_f32(x); }
NMA_OP Vec scale(Vec a, Vec whole) {
    return mul(a, vreinterpretq_f32_s32(vshlq_n_s32(vaddq_s32(vcvtq_s32_f32(whole), vdupq_n_s32(127)), 23)));
}
NMA_OP Vec even(const std::uint32_t* pairs) { return vreinterpretq_f32_u32(vshlq_n_u32(vld1q_u32(pairs), 16)); }
NMA_OP Vec odd(const std::uint32_t* pairs) {
    return vreinterpretq_f32_u32(vandq_u32(vld1q_u32(pairs), vdupq_n_u32(0xffff0000u)));
}

using Few = Indexed;  // in memory

#include "body.inl"

}  // namespace nma::neon

#undef NMA_FN
#undef NMA_OP
