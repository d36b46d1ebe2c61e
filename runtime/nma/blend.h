// The blend of Principled BRDFs: one evaluation, one density and one sample over all lobes. Twin of nma/target/blend.py.
//
// Directions are unit vectors in the local frame, z up, `wi` towards the viewer and `wo` towards the light.
#pragma once

#include "target.h"

namespace nma {

constexpr int MAX_INSTANCES = 5;

// Instances and their weights, which sum to one; `scale` dims the whole (see `bound`).
template <class T>
struct Blend {
    int count = 0;
    Principled<T> instances[MAX_INSTANCES];
    T weights[MAX_INSTANCES];
    Vec3<T> scale{T(1), T(1), T(1)};
};

// Chance of each lobe of an instance.
template <class T>
struct Odds {
    T diffuse, spec, clearcoat;
};

// A value f cos(theta_o) [1/sr] and the density of `sample` [1/sr].
template <class T>
struct Evaluation {
    Vec3<T> value{T(0), T(0), T(0)};
    T pdf = T(0);
};

// A direction with its value and density; pdf == 0 marks an invalid one.
template <class T>
struct Sample {
    Vec3<T> wo;
    Vec3<T> value;
    T pdf;
};

// A blend with the odds of its lobes at one cos(theta_i): what a shading point keeps.
template <class T>
struct Prepared {
    Blend<T> blend;
    Odds<T> odds[MAX_INSTANCES];
};

// Works out the odds of a blend's lobes at cos(theta_i), and with `bounded` dims it where it might reflect more light than
// it receives.
template <class T>
inline void weigh(Prepared<T>& prepared, T cos_theta_i, bool bounded) {
    Blend<T>& blend = prepared.blend;
    const T cosine = cos_theta_i > MIN_COS<T> ? cos_theta_i : T(1);
    Vec3<T> albedo{T(0), T(0), T(0)};
    T total = T(0);
    for (int k = 0; k < blend.count; ++k) {
        const Albedos<T> a = lobe_albedos<T>(blend.instances[k], cosine);
        const T w = blend.weights[k];
        Odds<T>& o = prepared.odds[k];
        o = {w * mean(a.diffuse), w * mean(a.spec), w * a.clearcoat};
        albedo = albedo + (a.diffuse + a.spec + a.clearcoat) * w;
        total += o.diffuse + o.spec + o.clearcoat;
    }
    const T share = T(1) / total;
    for (int k = 0; k < blend.count; ++k) {
        Odds<T>& o = prepared.odds[k];
        o = {o.diffuse * share, o.spec * share, o.clearcoat * share};
    }
    if (bounded) blend.scale = {T(1) / maximum(albedo.x, T(1)), T(1) / maximum(albedo.y, T(1)), T(1) / maximum(albedo.z, T(1))};
}

template <class T>
inline Prepared<T> prepare(const Blend<T>& blend, T cos_theta_i, bool bounded) {
    Prepared<T> made{blend, {}};
    weigh(made, cos_theta_i, bounded);
    return made;
}

// f cos(theta_o) [1/sr] and the density of `sample` [1/sr], both zero below the horizon.
template <class T>
inline Evaluation<T> eval_pdf(const Prepared<T>& prepared, const Vec3<T>& wi, const Vec3<T>& wo) {
    Evaluation<T> result;
    const Geometry<T> g = geometry<T>(wi, wo);
    if (!g.valid) return result;
    for (int k = 0; k < prepared.blend.count; ++k) {
        const Lobes<T> lobes = eval_pdf_lobes<T>(prepared.blend.instances[k], g);
        const Odds<T>& odds = prepared.odds[k];
        result.value = result.value + lobes.value * prepared.blend.weights[k];
        result.pdf += odds.diffuse * lobes.diffuse_pdf + odds.spec * lobes.spec_pdf + odds.clearcoat * lobes.clearcoat_pdf;
    }
    result.value = result.value * prepared.blend.scale;
    return result;
}

// A direction from three uniform numbers in [0, 1), with `eval_pdf` of it.
template <class T>
inline Sample<T> sample(const Prepared<T>& prepared, const Vec3<T>& wi, T u_lobe, T u1, T u2) {
    if (!(wi.z > MIN_COS<T>)) return {{T(0), T(0), T(1)}, {T(0), T(0), T(0)}, T(0)};
    const int count = prepared.blend.count;
    // All diffuse lobes come first, then all specular ones, then the clearcoats.
    T end = T(0);
    for (int k = 0; k < count; ++k) end += prepared.odds[k].diffuse;
    Vec3<T> wo;
    if (u_lobe < end) {
        wo = sample_diffuse<T>(u1, u2);
    } else {
        int k = 0;
        while (k < count && u_lobe >= (end += prepared.odds[k].spec)) ++k;
        if (k < count) {
            const auto [alpha_x, alpha_y] = spec_alpha<T>(prepared.blend.instances[k].roughness, prepared.blend.instances[k].anisotropic);
            wo = sample_spec<T>(wi, alpha_x, alpha_y, u1, u2);
        } else {
            k = 0;
            while (k < count - 1 && u_lobe >= (end += prepared.odds[k].clearcoat)) ++k;
            wo = sample_clearcoat<T>(wi, clearcoat_alpha<T>(prepared.blend.instances[k].clearcoat_gloss), u1, u2);
        }
    }
    const Evaluation<T> found = eval_pdf(prepared, wi, wo);
    return {wo, found.value, found.pdf};
}

}  // namespace nma
