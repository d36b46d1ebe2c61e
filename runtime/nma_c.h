/* The interface of the Neural Material Adapter for C, and for languages that can call C. nma.h explains what the
 * functions do.
 *
 * Compile nma_c.cpp with your code, or link the library nma_c. Arguments of the type `float*` are arrays. Directions
 * are unit vectors in the local frame, with z up. Many threads may share an adapter. Only `nma_load`, `nma_from_memory`
 * and `nma_curves_new` can fail, and then return NULL. `nma_load` and `nma_from_memory` also write the reason to
 * `message`. */
#ifndef NMA_C_H
#define NMA_C_H

#include <stddef.h>

#if defined(_WIN32) && defined(NMA_C_SHARED)
#define NMA_C_API __declspec(dllexport)
#elif defined(__GNUC__)
#define NMA_C_API __attribute__((visibility("default")))
#else
#define NMA_C_API
#endif

#ifdef __cplusplus
extern "C" {
#endif

typedef struct nma_adapter nma_adapter;
typedef struct nma_curves nma_curves;

#if defined(_MSC_VER)
#define NMA_ALIGNED __declspec(align(16))
#else
#define NMA_ALIGNED __attribute__((aligned(16)))
#endif

/* A BRDF at one shading point. The address of an `nma_brdf` must be a multiple of 16 bytes. */
typedef struct {
    NMA_ALIGNED float opaque[184];
} nma_brdf;
/* The former name of `nma_brdf`. */
typedef nma_brdf nma_material;
/* The size of an `nma_brdf` in bytes, for languages that cannot read this header. */
NMA_C_API size_t nma_brdf_size(void);

/* The instruction sets, in the order of nma::InstructionSet. NMA_FASTEST is the fastest supported instruction set that
 * computes in float32. To round the weights to bfloat16, add NMA_COMPACT to an instruction set (see nma::Options). */
enum { NMA_FASTEST, NMA_PORTABLE, NMA_NEON, NMA_AVX2, NMA_AVX512, NMA_AVX512_BF16, NMA_COMPACT = 0x100 };
NMA_C_API int nma_supported(int instruction_set);

NMA_C_API nma_adapter* nma_load(const char* path, int instruction_set, char* message, size_t message_size);
NMA_C_API nma_adapter* nma_from_memory(const void* bytes, size_t size, int instruction_set, char* message,
                                       size_t message_size);
NMA_C_API void nma_free(nma_adapter* adapter);

NMA_C_API int nma_parameter_count(const nma_adapter* adapter);
/* The name and the training range (its lower and upper end) of the parameter to which the number at `index` of the
 * array `parameters` belongs. `index` must be at least 0 and less than nma_parameter_count. */
NMA_C_API const char* nma_parameter_name(const nma_adapter* adapter, int index);
NMA_C_API void nma_parameter_range(const nma_adapter* adapter, int index, float range[2]);
/* Whether the adapter was fitted to a single material. For a single material, the function also writes
 * the parameters of the material to `parameters`. */
NMA_C_API int nma_single_material(const nma_adapter* adapter, float* parameters);
/* The index of the first number that is not allowed, or -1 if all numbers are allowed. A number is allowed if it is
 * finite and lies in its training range. Outside the training range, the BRDF does not match the source material. If
 * the adapter was fitted to a single material, only the parameters of that material are allowed. */
NMA_C_API int nma_check(const nma_adapter* adapter, const float* parameters);
/* Moves each number into its training range, and NaN to the lower end of the range. */
NMA_C_API void nma_clamp(const nma_adapter* adapter, float* parameters);
NMA_C_API int nma_output_count(const nma_adapter* adapter);
NMA_C_API int nma_instruction_set(const nma_adapter* adapter);
/* Whether the BRDF depends on the azimuth of the view direction. If the azimuth matters, pass directions, because
 * functions that take a cosine use the azimuth 0. */
NMA_C_API int nma_anisotropic(const nma_adapter* adapter);

NMA_C_API void nma_prepare(const nma_adapter* adapter, const float* parameters, float cos_theta_i, nma_brdf* brdf);
NMA_C_API void nma_prepare_many(const nma_adapter* adapter, int count, const float* parameters,
                                const float* cos_theta_i, nma_brdf* brdfs);

/* These functions do what `nma_prepare` and `nma_prepare_many` do, but take directions `wi` of three floats each
 * instead of cosines. Isotropic adapters read only z. */
NMA_C_API void nma_prepare_direction(const nma_adapter* adapter, const float* parameters, const float* wi,
                                     nma_brdf* brdf);
NMA_C_API void nma_prepare_direction_many(const nma_adapter* adapter, int count, const float* parameters,
                                          const float* wi, nma_brdf* brdfs);

/* The raw outputs of the network: `nma_output_count` numbers for each query. */
NMA_C_API void nma_outputs_many(const nma_adapter* adapter, int count, const float* parameters,
                                const float* cos_theta_i, float* outputs);
NMA_C_API void nma_outputs_direction_many(const nma_adapter* adapter, int count, const float* parameters,
                                          const float* wi, float* outputs);

/* The curves of an untextured material. Returns NULL if the adapter is anisotropic, or if memory runs out. */
NMA_C_API nma_curves* nma_curves_new(const nma_adapter* adapter, const float* parameters);
NMA_C_API void nma_curves_at(const nma_curves* curves, float cos_theta_i, nma_brdf* brdf);
NMA_C_API void nma_curves_free(nma_curves* curves);

/* For each BRDF, `nma_eval_pdf` writes four floats: f cos(theta_o) [1/sr] as RGB, and the density [1/sr]. `nma_sample`
 * draws a direction from three uniform numbers in [0, 1), which it reads from `u`. `nma_sample` writes seven floats:
 * the direction, its value and its density. A density of 0 marks an invalid direction. */
NMA_C_API void nma_eval_pdf(int count, const nma_brdf* brdfs, const float* wi, const float* wo, float* value_pdf);
NMA_C_API void nma_sample(int count, const nma_brdf* brdfs, const float* wi, const float* u, float* wo_value_pdf);

/* For each BRDF, writes the directional albedo at `wi` as RGB. The albedo is at most 1 and has no noise. */
NMA_C_API void nma_albedo(int count, const nma_brdf* brdfs, const float* wi, float* albedo);

#ifdef __cplusplus
}
#endif

#endif
