/* Neural Material Adapter for C, and for whatever calls C: see nma.h for what the functions do.
 *
 * Compile nma_c.cpp beside your code, or link the library nma_c. Pointers are to arrays of floats; directions are unit
 * vectors in the local frame, z up. An adapter may be shared by threads. Only loading and `nma_curves_new` can fail:
 * they return NULL, and loading says why in `message`. */
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

/* A BRDF at one shading point, on a boundary of 16 bytes. */
typedef struct {
    NMA_ALIGNED float opaque[168];
} nma_brdf;
/* What it was called before. */
typedef nma_brdf nma_material;
/* The bytes of one, for languages that do not read this header. */
NMA_C_API size_t nma_brdf_size(void);

/* In the order of nma::InstructionSet. NMA_FASTEST is the fastest one here that computes in float32. Add NMA_COMPACT to
 * one to have weights rounded to bfloat16: nma::Options. */
enum { NMA_FASTEST, NMA_PORTABLE, NMA_NEON, NMA_AVX2, NMA_AVX512, NMA_AVX512_BF16, NMA_COMPACT = 0x100 };
NMA_C_API int nma_supported(int instruction_set);

NMA_C_API nma_adapter* nma_load(const char* path, int instruction_set, char* message, size_t message_size);
NMA_C_API nma_adapter* nma_from_memory(const void* bytes, size_t size, int instruction_set, char* message,
                                       size_t message_size);
NMA_C_API void nma_free(nma_adapter* adapter);

NMA_C_API int nma_parameter_count(const nma_adapter* adapter);
/* Of the parameter number `number`, counted from 0: the parameter's name, and its training range, low and high. */
NMA_C_API const char* nma_parameter_name(const nma_adapter* adapter, int number);
NMA_C_API void nma_parameter_range(const nma_adapter* adapter, int number, float range[2]);
/* Whether it knows a single material of its class; the parameters of that are written then. */
NMA_C_API int nma_single_material(const nma_adapter* adapter, float* parameters);
/* The first number that is not finite or beyond its training range, where values are made up, or not of the single
 * material that it knows; -1 if there is none. */
NMA_C_API int nma_check(const nma_adapter* adapter, const float* parameters);
/* Moves each into its training range, NaN to the lower end. */
NMA_C_API void nma_clamp(const nma_adapter* adapter, float* parameters);
NMA_C_API int nma_output_count(const nma_adapter* adapter);
NMA_C_API int nma_instruction_set(const nma_adapter* adapter);
/* Whether the view's azimuth matters. Cosines alone stand for the azimuth 0 then: give directions. */
NMA_C_API int nma_anisotropic(const nma_adapter* adapter);

NMA_C_API void nma_prepare(const nma_adapter* adapter, const float* parameters, float cos_theta_i, nma_brdf* brdf);
NMA_C_API void nma_prepare_many(const nma_adapter* adapter, int count, const float* parameters,
                                const float* cos_theta_i, nma_brdf* brdfs);

/* The same seen from directions, three floats each; of isotropic adapters only their z matters. */
NMA_C_API void nma_prepare_direction(const nma_adapter* adapter, const float* parameters, const float* wi,
                                     nma_brdf* brdf);
NMA_C_API void nma_prepare_direction_many(const nma_adapter* adapter, int count, const float* parameters,
                                          const float* wi, nma_brdf* brdfs);

/* Raw outputs of the network, `nma_output_count` for each query. */
NMA_C_API void nma_outputs_many(const nma_adapter* adapter, int count, const float* parameters,
                                const float* cos_theta_i, float* outputs);
NMA_C_API void nma_outputs_direction_many(const nma_adapter* adapter, int count, const float* parameters,
                                          const float* wi, float* outputs);

/* Curves of an untextured material. NULL for an anisotropic adapter, which has none, and where memory is short. */
NMA_C_API nma_curves* nma_curves_new(const nma_adapter* adapter, const float* parameters);
NMA_C_API void nma_curves_at(const nma_curves* curves, float cos_theta_i, nma_brdf* brdf);
NMA_C_API void nma_curves_free(nma_curves* curves);

/* For each BRDF: `value_pdf` gets f cos(theta_o) [1/sr] as RGB and the density [1/sr]; `wo_value_pdf` a direction
 * before them, drawn with three uniform numbers in [0, 1) from `u`. A density of 0 marks an invalid direction. */
NMA_C_API void nma_eval_pdf(int count, const nma_brdf* brdfs, const float* wi, const float* wo, float* value_pdf);
NMA_C_API void nma_sample(int count, const nma_brdf* brdfs, const float* wi, const float* u, float* wo_value_pdf);

/* For each BRDF the directional albedo at `wi` as RGB, at most 1, without noise. */
NMA_C_API void nma_albedo(int count, const nma_brdf* brdfs, const float* wi, float* albedo);

#ifdef __cplusplus
}
#endif

#endif
