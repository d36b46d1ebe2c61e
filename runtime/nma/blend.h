// A blend of Principled BRDFs: its value, and a density and a sampling function that cover all its lobes.
// nma/target/blend.py is the Python version of this code.
//
// Directions are unit vectors in the local frame, with z up. `wi` points towards the viewer, and `wo` towards the
// light.
#pragma once

#include "generated/target.h"
#include "kernels/macros.h"
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
// The value of the blend is multiplied by `scale`, a factor for each colour channel. If `under_interface` is true, all
// instances lie under `interface`, whose own reflection takes the place of the clearcoats.
template <class T>
struct Blend {
    int count = 0;
    bool under_interface = false;
    Interface<T> interface{T(0), T(0)};
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

// Fills in the lobe probabilities in proportion to the estimated albedos of the lobes, which `albedos_of` returns for
// the instances of a pack. If `bounded` is true, also fills in `scale`, so that the blend reflects no more light than
// it receives.
template <class T, class Albedo>
inline void share_out(Blend<T>& blend, bool bounded, const Albedo& albedos_of) {
    // Lanes 0 to 2 of `sum` hold the albedo of the blend in red, green and blue. Lane 3 holds the sum of all
    // probabilities before they are normalised.
    Lanes<T> sum(T(0));
    for (int n = 0; n < blend.used(); ++n) {
        Pack<T>& pack = blend.packs[n];
        const Albedos<Lanes<T>> a = albedos_of(pack.instances);
        const Lanes<T> w = pack.weights;
        LobeProbabilities<Lanes<T>>& o = pack.probabilities;
        o = {w * mean(a.diffuse), w * mean(a.spec) * a.leaving, w * a.clearcoat};
        const Vec3<Lanes<T>> albedo = (a.diffuse + a.clearcoat + a.spec) * w;
        sum += sums(albedo.x, albedo.y, albedo.z, o.diffuse + o.spec + o.clearcoat);
    }
    const Lanes<T> inverse = Lanes<T>(T(1)) / maximum(sum, Lanes<T>(T(1), T(1), T(1), T(0)));
    const Lanes<T> share = inverse[3];
    for (int n = 0; n < blend.used(); ++n) {
        LobeProbabilities<Lanes<T>>& o = blend.packs[n].probabilities;
        o = {o.diffuse * share, o.spec * share, o.clearcoat * share};
    }
    if (bounded) blend.scale = {inverse[0], inverse[1], inverse[2]};
}

// Fills in the lobe probabilities at cos(theta_i) and, if `bounded` is true, `scale`.
template <class T>
inline void set_lobe_probabilities(Blend<T>& blend, T cos_theta_i, bool bounded) {
    using Instances = Principled<Lanes<T>>;
    const Lanes<T> cosine = cos_theta_i > MIN_COS<T> ? cos_theta_i : T(1);
    if (!blend.under_interface)
        return share_out(blend, bounded, [&](const Instances& p) { return lobe_albedos<Lanes<T>>(p, cosine); });
    const Interface<Lanes<T>> interface{blend.interface.alpha, blend.interface.eta};
    share_out(blend, bounded, [&](const Instances& p) { return lobe_albedos_below<Lanes<T>>(p, interface, cosine); });
}

// Copies each number of a vector or of a `Geometry` to all lanes.
template <class T>
inline Vec3<Lanes<T>> spread(const Vec3<T>& v) {
    return {v.x, v.y, v.z};
}
template <class T>
inline Geometry<Lanes<T>> spread(const Geometry<T>& g) {
    return {g.valid, spread(g.wi), spread(g.wo), spread(g.h), g.cos_d, g.weight_i, g.weight_o, g.weight_d, g.clearcoat};
}

// Adds up the values and the densities of all lobes, which `lobes_of` returns for the instances of a pack.
template <class T, class Lobe>
inline Evaluation<T> added_up(const Blend<T>& blend, const Lobe& lobes_of) {
    Evaluation<T> result;
    for (int n = 0; n < blend.used(); ++n) {
        const Pack<T>& pack = blend.packs[n];
        const Lobes<Lanes<T>> lobes = lobes_of(pack.instances);
        result.value = result.value + sum(lobes.value * pack.weights);
        result.pdf += sum(pack.probabilities.diffuse * lobes.diffuse_pdf + pack.probabilities.spec * lobes.spec_pdf +
                          pack.probabilities.clearcoat * lobes.clearcoat_pdf);
    }
    result.value = result.value * blend.scale;
    return result;
}

// The lobes of at most two instances under an interface: `crossing` and `eval_pdf_lobes_below` in one, with less work.
// The lanes 0 and 1 compute the refracted `wi`, and the lobes of the instances. The lanes 2 and 3, which hold no
// instance, compute the refracted `wo`, and the interface's own lobe.
template <class T>
inline Lobes<Lanes<T>> pair_below(const Interface<T>& interface, const Principled<Lanes<T>>& p, const Geometry<T>& g) {
    using Four = Lanes<T>;
    const Four alpha(interface.alpha), eta(interface.eta);
    const T inverse = T(1) / interface.eta;
    const Vec3<Four> wi = spread(g.wi), wo = spread(g.wo);
    const Vec3<Four> below = refracted<Four>(halves(wi, wo), eta, inverse);
    const auto [x, y] = spec_alpha<Four>(p.roughness, p.anisotropic);
    const auto [spec, pdf] = microfacet_lobe<Four>(halves(shifted<Four>(below, p.shift), wi), halves(turned(below), wo),
                                                   halves(x, alpha), halves(y, alpha));
    // The reflectance of the interface's facets, and the part of the light that is lost.
    const Four cosine = halves(Four(g.cos_d), wo.z);
    const Four reflectance = dielectric_reflectance<Four>(cosine, cosine * cosine, eta);
    const auto [jacobian, diffuse, flat] = way_out<T>(g.wo.z, below.z[2], inverse);
    const Crossing<Four> c{wi, wo, jacobian, reflectance[2], diffuse, flat, spec[2] * reflectance[0], pdf[2]};
    return lobes_below<Four>(p, c, spec, pdf);
}

// `eval_pdf` for a blend under an interface. All calls are inlined, because the compiler would pass the geometry and
// the crossing to them in memory, which takes 5 ns.
template <class T>
NMA_WHOLE inline Evaluation<T> eval_pdf_below(const Blend<T>& blend, const Vec3<T>& wi, const Vec3<T>& wo) {
    using Instances = Principled<Lanes<T>>;
    const Geometry<T> g = geometry<T>(wi, wo);
    if (!g.valid) return {};
    if (blend.count <= 2) return added_up(blend, [&](const Instances& p) { return pair_below(blend.interface, p, g); });
    const Geometry<Lanes<T>> wide = spread(g);
    const Interface<Lanes<T>> interface{blend.interface.alpha, blend.interface.eta};
    const Crossing<Lanes<T>> c = crossing<Lanes<T>>(interface, wide);
    return added_up(blend, [&](const Instances& p) { return eval_pdf_lobes_below<Lanes<T>>(p, c); });
}

// The value f cos(theta_o) [1/sr] and the density of `sample` [1/sr]. The value and the density are 0 below the
// horizon.
template <class T>
inline Evaluation<T> eval_pdf(const Blend<T>& blend, const Vec3<T>& wi, const Vec3<T>& wo) {
    if (blend.under_interface) return eval_pdf_below(blend, wi, wo);
    const Geometry<T> g = geometry<T>(wi, wo);
    if (!g.valid) return {};
    const Geometry<Lanes<T>> wide = spread(g);
    return added_up(blend, [&](const Principled<Lanes<T>>& p) { return eval_pdf_lobes<Lanes<T>>(p, wide); });
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

// Draws a direction from three uniform numbers in [0, 1). If `wi` is below the horizon, returns the normal.
template <class T>
inline Vec3<T> draw(const Blend<T>& blend, const Vec3<T>& wi, T u_lobe, T u1, T u2) {
    if (!(wi.z > MIN_COS<T>)) return {T(0), T(0), T(1)};
    // `u_lobe` chooses the lobe. Small values choose diffuse lobes, larger values specular lobes, and the largest
    // values clearcoats, or the interface's own lobe.
    T end = T(0);
    for (int n = 0; n < blend.used(); ++n) end += sum(blend.packs[n].probabilities.diffuse);
    if (u_lobe < end) return sample_diffuse<T>(u1, u2);
    int k = chosen(blend, &LobeProbabilities<Lanes<T>>::spec, u_lobe, end);
    if (k < blend.count) {
        const Principled<Lanes<T>>& p = blend.packs[k / LANES].instances;
        const auto [alpha_x, alpha_y] = spec_alpha<T>(p.roughness[k % LANES], p.anisotropic[k % LANES]);
        if (!blend.under_interface) return sample_spec<T>(wi, alpha_x, alpha_y, u1, u2);
        return sample_below<T>(wi, blend.interface.eta, p.shift[k % LANES], alpha_x, alpha_y, u1, u2);
    }
    if (blend.under_interface) return sample_spec<T>(wi, blend.interface.alpha, blend.interface.alpha, u1, u2);
    k = std::min(chosen(blend, &LobeProbabilities<Lanes<T>>::clearcoat, u_lobe, end), blend.count - 1);
    const T gloss = blend.packs[k / LANES].instances.clearcoat_gloss[k % LANES];
    return sample_clearcoat<T>(wi, clearcoat_alpha<T>(gloss), u1, u2);
}

// Draws a direction from three uniform numbers in [0, 1). Returns the direction with its value and its density.
template <class T>
inline Sample<T> sample(const Blend<T>& blend, const Vec3<T>& wi, T u_lobe, T u1, T u2) {
    const Vec3<T> wo = draw(blend, wi, u_lobe, u1, u2);
    const Evaluation<T> found = eval_pdf(blend, wi, wo);
    return {wo, found.value, found.pdf};
}

}  // namespace nma
