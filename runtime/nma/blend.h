// A blend of Principled BRDFs: its value, and a density and a sampling function that cover all its lobes.
// nma/target/blend.py is the Python version of this code.
//
// Directions are unit vectors in the local frame, with z up. `wi` points towards the viewer, and `wo` towards the
// light.
#pragma once

#include "generated/target.h"
#include "lanes.h"

namespace nma {

constexpr int MAX_PACKS = 2, MAX_INSTANCES = MAX_PACKS * LANES;

// The lobe probabilities of an instance: for each lobe, the probability that a sample is drawn from it.
template <class T>
struct LobeProbabilities {
    T diffuse, spec, clearcoat;
};

// Four instances with their weights and their lobe probabilities, one instance per lane. A lane without an instance
// holds zeros.
template <class T>
struct Pack {
    Principled<Lanes<T>> instances;
    Lanes<T> weights;
    LobeProbabilities<Lanes<T>> probabilities;

    // All numbers of the pack as an array, in the order of the members above.
    Lanes<T>* as_array() { return reinterpret_cast<Lanes<T>*>(this); }
    const Lanes<T>* as_array() const { return reinterpret_cast<const Lanes<T>*>(this); }
};

// Instances and their weights, which sum to 1. `set_lobe_probabilities` fills in the lobe probabilities and `scale`.
// The value of the blend is multiplied by `scale`, a factor for each colour channel.
template <class T>
struct Blend {
    int count = 0;
    Pack<T> packs[MAX_PACKS];
    Vec3<T> scale;

    Blend() = default;
    explicit Blend(int instances) : count(instances), scale{T(1), T(1), T(1)} { std::fill_n(packs, used(), Pack<T>{}); }

    // The count of packs that contain instances.
    int used() const { return (count + LANES - 1) / LANES; }

    void set(int k, const Principled<T>& instance, T weight) {
        static_assert(sizeof(Principled<Lanes<T>>) == PRINCIPLED_SIZE * sizeof(Lanes<T>));
        Pack<T>& pack = packs[k / LANES];
        const auto* from = reinterpret_cast<const T*>(&instance);
        for (int f = 0; f < PRINCIPLED_SIZE; ++f) pack.as_array()[f].set(k % LANES, from[f]);
        pack.weights.set(k % LANES, weight);
    }
    Principled<T> instance(int k) const {
        Principled<T> found;
        const Lanes<T>* from = packs[k / LANES].as_array();
        auto* to = reinterpret_cast<T*>(&found);
        for (int f = 0; f < PRINCIPLED_SIZE; ++f) to[f] = from[f][k % LANES];
        return found;
    }
    T weight(int k) const { return packs[k / LANES].weights[k % LANES]; }

    // The count of numbers that describe an instance.
    static constexpr int PRINCIPLED_SIZE = sizeof(Principled<T>) / sizeof(T);
};

// The value f cos(theta_o) [1/sr] of a pair of directions, and the density with which `sample` draws `wo` [1/sr].
template <class T>
struct Evaluation {
    Vec3<T> value{T(0), T(0), T(0)};
    T pdf = T(0);
};

// A direction with its value and its density. A density of 0 marks an invalid direction.
template <class T>
struct Sample {
    Vec3<T> wo;
    Vec3<T> value;
    T pdf;
};

// Fills in the lobe probabilities at cos(theta_i), in proportion to the estimated albedos of the lobes. If `bounded` is
// true, also fills in `scale`, so that the blend reflects no more light than it receives.
template <class T>
inline void set_lobe_probabilities(Blend<T>& blend, T cos_theta_i, bool bounded) {
    const Lanes<T> cosine = cos_theta_i > MIN_COS<T> ? cos_theta_i : T(1);
    // Lanes 0 to 2 of `sum` hold the albedo of the blend in red, green and blue. Lane 3 holds the sum of these three
    // albedos, which is three times the sum of all probabilities before they are normalised.
    Lanes<T> sum(T(0));
    for (int n = 0; n < blend.used(); ++n) {
        Pack<T>& pack = blend.packs[n];
        const Albedos<Lanes<T>> a = lobe_albedos<Lanes<T>>(pack.instances, cosine);
        const Lanes<T> w = pack.weights;
        pack.probabilities = {w * mean(a.diffuse), w * mean(a.spec), w * a.clearcoat};
        const Vec3<Lanes<T>> albedo = (a.diffuse + a.clearcoat + a.spec) * w;
        sum += sums(albedo.x, albedo.y, albedo.z, albedo.x + albedo.y + albedo.z);
    }
    const Lanes<T> inverse = Lanes<T>(T(1), T(1), T(1), T(3)) / maximum(sum, Lanes<T>(T(1), T(1), T(1), T(0)));
    const Lanes<T> share = inverse[3];
    for (int n = 0; n < blend.used(); ++n) {
        LobeProbabilities<Lanes<T>>& o = blend.packs[n].probabilities;
        o = {o.diffuse * share, o.spec * share, o.clearcoat * share};
    }
    if (bounded) blend.scale = {inverse[0], inverse[1], inverse[2]};
}

// Copies each number of a `Geometry` to all lanes.
template <class T>
inline Geometry<Lanes<T>> spread(const Geometry<T>& g) {
    const auto all = [](const Vec3<T>& v) { return Vec3<Lanes<T>>{v.x, v.y, v.z}; };
    return {g.valid, all(g.wi), all(g.wo), all(g.h), g.cos_d, g.weight_i, g.weight_o, g.weight_d, g.clearcoat};
}

// The value f cos(theta_o) [1/sr] and the density of `sample` [1/sr]. The value and the density are 0 below the
// horizon.
template <class T>
inline Evaluation<T> eval_pdf(const Blend<T>& blend, const Vec3<T>& wi, const Vec3<T>& wo) {
    Evaluation<T> result;
    const Geometry<T> g = geometry<T>(wi, wo);
    if (!g.valid) return result;
    const Geometry<Lanes<T>> wide = spread(g);
    for (int n = 0; n < blend.used(); ++n) {
        const Pack<T>& pack = blend.packs[n];
        const Lobes<Lanes<T>> lobes = eval_pdf_lobes<Lanes<T>>(pack.instances, wide);
        result.value = result.value + sum(lobes.value * pack.weights);
        result.pdf += sum(pack.probabilities.diffuse * lobes.diffuse_pdf + pack.probabilities.spec * lobes.spec_pdf +
                          pack.probabilities.clearcoat * lobes.clearcoat_pdf);
    }
    result.value = result.value * blend.scale;
    return result;
}

// Returns the index of the instance whose interval contains the uniform number `u`. The intervals are consecutive and
// begin at `start`. The length of an instance's interval is the probability of its `lobe`. Moves `start` to the end of
// the chosen interval. Returns `count` if `u` lies beyond all intervals.
template <class T>
inline int chosen(const Blend<T>& blend, Lanes<T> LobeProbabilities<Lanes<T>>::* lobe, T u, T& start) {
    int k = 0;
    while (k < blend.count && u >= (start += (blend.packs[k / LANES].probabilities.*lobe)[k % LANES])) ++k;
    return k;
}

// Draws a direction from three uniform numbers in [0, 1). Returns the direction with its value and its density.
template <class T>
inline Sample<T> sample(const Blend<T>& blend, const Vec3<T>& wi, T u_lobe, T u1, T u2) {
    if (!(wi.z > MIN_COS<T>)) return {{T(0), T(0), T(1)}, {T(0), T(0), T(0)}, T(0)};
    // `u_lobe` chooses the lobe. Small values choose diffuse lobes, larger values specular lobes, and the largest
    // values clearcoats.
    T end = T(0);
    for (int n = 0; n < blend.used(); ++n) end += sum(blend.packs[n].probabilities.diffuse);
    Vec3<T> wo;
    if (u_lobe < end) {
        wo = sample_diffuse<T>(u1, u2);
    } else if (int k = chosen(blend, &LobeProbabilities<Lanes<T>>::spec, u_lobe, end); k < blend.count) {
        const Principled<Lanes<T>>& p = blend.packs[k / LANES].instances;
        const auto [alpha_x, alpha_y] = spec_alpha<T>(p.roughness[k % LANES], p.anisotropic[k % LANES]);
        wo = sample_spec<T>(wi, alpha_x, alpha_y, u1, u2);
    } else {
        k = std::min(chosen(blend, &LobeProbabilities<Lanes<T>>::clearcoat, u_lobe, end), blend.count - 1);
        const T gloss = blend.packs[k / LANES].instances.clearcoat_gloss[k % LANES];
        wo = sample_clearcoat<T>(wi, clearcoat_alpha<T>(gloss), u1, u2);
    }
    const Evaluation<T> found = eval_pdf(blend, wi, wo);
    return {wo, found.value, found.pdf};
}

}  // namespace nma
