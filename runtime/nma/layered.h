// The simulated layered material: a rough dielectric interface over a homogeneous medium over a rough conductor,
// simulated by random walks. This file is the scalar version of nma/sources/layered.py and nma/sources/layered_eval.py,
// which explain the method (Guo, Hasan and Zhao 2018, "position-free").
//
// Directions are unit vectors in the local frame, with z up. Values are noisy estimates of f cos(theta_o) [1/sr].
// Densities are per sr.
#pragma once

#include <cstdint>

#include "generated/constants.h"
#include "generated/target.h"

namespace nma::layered {

using Vec = Vec3<float>;

// The random number generator PCG of O'Neill 2014, with 64 bits of state and 32 bits of output (XSH-RR).
class Random {
public:
    Random(std::uint64_t state, std::uint64_t stream) : increment_(stream << 1 | 1) {
        next();
        state_ += state;
        next();
    }

    std::uint32_t next() {
        const std::uint64_t old = state_;
        state_ = old * 6364136223846793005ull + increment_;
        const auto mixed = static_cast<std::uint32_t>((old >> 18 ^ old) >> 27);
        const auto turn = static_cast<std::uint32_t>(old >> 59);
        return mixed >> turn | mixed << (-turn & 31);
    }

    // A uniform number in [0, 1).
    float uniform() { return static_cast<float>(next() >> 8) * 0x1p-24f; }

private:
    std::uint64_t state_ = 0, increment_;
};

// The interfaces and the medium of the layered material. `eta_bottom` and `k_bottom` are the conductor's complex index
// of refraction divided by that of the coat, per colour channel.
struct Stack {
    float alpha_top, alpha_bottom, eta_top;
    Vec eta_bottom, k_bottom, albedo;
    float sigma_t;

    // The stack that a parameter vector of the class `layered3` describes.
    static Stack of(const float* p) {
        using namespace layered3;
        const auto colour = [p](int first) { return Vec{p[first], p[first + 1], p[first + 2]}; };
        const float eta = p[ETA_TOP] < 1.0f + INDEX_MATCHED ? 1.0f : p[ETA_TOP], inverse = 1.0f / eta;
        return {p[ALPHA_TOP],   p[ALPHA_BOTTOM], eta, colour(ETA_CONDUCTOR) * inverse, colour(K_CONDUCTOR) * inverse,
                colour(ALBEDO), p[SIGMA_T]};
    }
};

// A walk: its direction, its throughput, and its height in the slab (1 at the top, 0 at the bottom).
struct Walk {
    Vec direction, throughput;
    float height;
    bool inside, alive;
};

namespace detail {

inline float max_component(const Vec& c) { return maximum(c.x, maximum(c.y, c.z)); }
// `w`, moved slightly above the horizon, because visible normals are undefined at the horizon.
inline Vec above(const Vec& w) { return {w.x, w.y, maximum(w.z, 1e-7f)}; }
// The inverse of the density of an event. The wider the lobe of the event, the larger is this inverse. `unscattered`
// computes the weights of multiple importance sampling from the inverse.
inline float bluntness(float density) { return 1.0f / maximum(density, 1e-20f); }

// The reflectance of the conductor, per colour channel.
inline Vec conductor(float cosine, const Stack& stack) {
    const Vec &eta = stack.eta_bottom, &k = stack.k_bottom;
    return {fresnel_conductor<float>(cosine, eta.x, k.x), fresnel_conductor<float>(cosine, eta.y, k.y),
            fresnel_conductor<float>(cosine, eta.z, k.z)};
}

// The fraction of the light along `w` that crosses a layer of the slab without scattering or absorption. `depth` is the
// thickness of the crossed layer, as a fraction of the slab.
inline float transmittance(const Stack& stack, float depth, const Vec& w) {
    return stack.sigma_t > 0.0f ? exp(-stack.sigma_t * depth / maximum(absolute(w.z), 1e-7f)) : 1.0f;
}

// Russian roulette on the brightest channel. If `exempt` is true, the walk always survives.
inline void roulette(Walk& walk, bool exempt, bool trapped, Random& random) {
    if (exempt) return;
    const float chance =
        minimum(max_component(walk.throughput) * (1.0f / ROULETTE_THRESHOLD), trapped ? TRAPPED_SURVIVAL : 1.0f);
    if (chance < 1.0f && random.uniform() >= chance) {
        walk.throughput = {0.0f, 0.0f, 0.0f};
        walk.alive = false;
        return;
    }
    walk.throughput = walk.throughput * (1.0f / chance);
    walk.alive = chance > 0.0f;
}

// Advances a walk by one free flight through a medium of extinction `sigma_t`, and by the event at the end of that
// flight: scattering in the medium, or reflection or refraction at an interface. Returns whether the walk left the
// material.
inline bool step(const Stack& stack, float sigma_t, Walk& walk, Random& random) {
    const Vec d = walk.direction;
    if (walk.inside && sigma_t > 0.0f) {
        const float height = walk.height - d.z * (log(1.0f - random.uniform()) / sigma_t);
        if (height > 0.0f && height < 1.0f) {
            const float z = 1.0f - 2.0f * random.uniform(), r = safe_sqrt(1.0f - z * z);
            const float phi = 2.0f * PI<float> * random.uniform();
            walk.direction = {r * cos(phi), r * sin(phi), z};
            walk.height = height;
            walk.throughput = walk.throughput * stack.albedo;
            roulette(walk, false, false, random);
            return false;
        }
    }
    const bool upward = walk.inside && d.z > 0.0f, at_bottom = walk.inside && !upward;
    const float alpha = at_bottom ? stack.alpha_bottom : stack.alpha_top;
    const Vec w{-d.x, -d.y, maximum(absolute(d.z), 1e-7f)};
    const float u1 = random.uniform(), u2 = random.uniform();
    const Vec m = sample_visible_normal<float>(w, alpha, alpha, u1, u2);
    const float cos_m = maximum(dot(w, m), 0.0f);
    Vec out;
    bool reflects = true, trapped = false, valid;
    if (at_bottom) {
        out = reflect<float>(w, m);
        valid = out.z > 0.0f;
        walk.throughput = walk.throughput * conductor(cos_m, stack);
    } else {
        const float eta = upward ? 1.0f / stack.eta_top : stack.eta_top;
        const auto [fresnel, cos_t] = fresnel_dielectric<float>(cos_m, eta);
        reflects = random.uniform() < fresnel;
        trapped = upward && cos_t <= 0.0f;
        out = reflects ? reflect<float>(w, m) : refract<float>(w, m, cos_t, eta);
        valid = reflects ? out.z > 0.0f : out.z < 0.0f;
    }
    walk.throughput = valid ? walk.throughput * smith_g1<float>(out, alpha, alpha) : Vec{0.0f, 0.0f, 0.0f};
    if (upward) out.z = -out.z;
    const bool leaves = !at_bottom && out.z > 0.0f && reflects != walk.inside;
    walk.direction = out;
    walk.height = at_bottom ? 0.0f : 1.0f;
    walk.inside = walk.inside || !reflects;
    roulette(walk, leaves, trapped, random);
    if (leaves) walk.alive = false;
    return leaves;
}

// Starts a walk from the direction `w` just below the coat's surface. The walk is always refracted there, because the
// light that the coat's surface reflects has a closed form.
inline Walk enter(const Stack& stack, const Vec& w, Random& random) {
    const float alpha = stack.alpha_top, u1 = random.uniform(), u2 = random.uniform();
    const Vec view = above(w), m = sample_visible_normal<float>(view, alpha, alpha, u1, u2);
    const auto [fresnel, cos_t] = fresnel_dielectric<float>(maximum(dot(view, m), 0.0f), stack.eta_top);
    const Vec down = refract<float>(view, m, cos_t, stack.eta_top);
    const float weight = down.z < 0.0f ? (1.0f - fresnel) * smith_g1<float>(down, alpha, alpha) : 0.0f;
    return {down, {weight, weight, weight}, 1.0f, true, weight > 0.0f};
}

// A segment of a walk that did not scatter in the medium. `reached` is the throughput on the segment, divided by the
// probability that the segment was chosen.
struct Way {
    Vec direction, reached;
};

// One segment of a walk, chosen at random from all but the first segment. The choice is weighted reservoir sampling
// (Chao 1982).
struct Detour {
    Vec direction, tint{0.0f, 0.0f, 0.0f};
    float total = 0.0f;

    // Replaces the chosen segment by the current segment of `walk`, with a probability proportional to the brightest
    // channel of the current throughput.
    void offer(const Walk& walk, Random& random) {
        const float weight = walk.alive ? max_component(walk.throughput) : 0.0f;
        total += weight;
        if (weight > 0.0f && random.uniform() * total < weight) {
            direction = walk.direction;
            tint = walk.throughput * (1.0f / weight);
        }
    }
};

// Returns two numbers (q, t) for light that leaves through the coat's surface. Inside the coat, the light travels along
// `up`. Outside, the light travels along wo. q [1/sr] is the density with which a walk from wo is refracted into -up at
// a visible normal. q t [1/sr] is the density with which light along `up` is refracted to wo.
inline std::pair<float, float> out_through_coat(const Stack& stack, const Vec& wo, const Vec& up) {
    const float alpha = stack.alpha_top, eta = stack.eta_top;
    const bool matched = eta == 1.0f;
    const Vec half = up * eta - wo;
    const float length2 = maximum(dot(half, half), 1e-20f);
    const Vec m = half * (1.0f / sqrt(length2));
    const float cos_o = dot(wo, m), cos_up = dot(up, m);
    if (!matched && !(m.z > 0.0f && cos_o > 0.0f && cos_up > 0.0f)) return {0.0f, 0.0f};
    const float fresnel = matched ? 0.0f : std::get<0>(fresnel_dielectric<float>(clip(cos_o, 0.0f, 1.0f), eta));
    const float t = (1.0f - fresnel) * smith_g1<float>(up, alpha, alpha) * wo.z / (eta * eta * maximum(up.z, 1e-7f));
    return {matched ? 0.0f : visible_normal_pdf<float>(above(wo), m, alpha, alpha) * (eta * eta) * cos_up / length2, t};
}

// The approximate density [1/sr] of the conductor's reflection from `w_in` to `up`. The density from `up` to `w_in` is
// the same.
inline float sharpness(const Stack& stack, const Vec& w_in, const Vec& up) {
    return 0.25f * ggx_d<float>(normalize(w_in + up), stack.alpha_bottom, stack.alpha_bottom);
}

// The density [1/sr] of `out` when `w` is reflected at a visible normal.
inline float mirror_pdf(const Vec& w, const Vec& out, float alpha) {
    const Vec m = normalize(w + out);
    return visible_normal_pdf<float>(w, m, alpha, alpha) / (4.0f * maximum(dot(w, m), 1e-7f));
}

// Estimates the light from wi to wo that does not scatter in the medium. Also chooses a segment of the walk `there`
// (see `Detour`), and stores it in `detour`.
//
// The light enters through the coat, hits the conductor once or more, and leaves through the coat. The walk `there`
// starts at wi, and the walk `back` starts at wo. Each refraction or reflection on the light path is an event. The
// walks draw all events at random except one, the connection, where the two walks are joined. Both directions at the
// connection are known, so its density is evaluated.
//
// The connection is either the last hit of the conductor or the exit through the coat. `evaluate` calls this function a
// second time with wi and wo exchanged and `forward` false. In the second call, the connection is the first hit or the
// entrance, seen from wi. Each connection has a weight `share` of multiple importance sampling, because several
// connections can make the same path (balance heuristic, Veach 1997, eq. 9.8). `share` is proportional to the
// `bluntness` of the connection, so connections with narrow lobes get small weights.
inline Vec unscattered(const Stack& stack, const Vec& wi, const Walk& there, const Vec& wo, const Walk& back,
                       Random& random, bool forward, Way& detour) {
    const Vec drawn_up = -back.direction;
    const bool matched = stack.eta_top == 1.0f;
    const auto [drawn_q, drawn_t] = out_through_coat(stack, wo, drawn_up);
    const float way_in = bluntness(out_through_coat(stack, wi, -there.direction).first);
    const float drawn_passes = drawn_t * transmittance(stack, 1.0f, drawn_up), blunt_q = bluntness(drawn_q);
    Walk walk = there;
    Vec total{0.0f, 0.0f, 0.0f};
    float first = 0.0f;
    Detour kept{there.direction};
    while (walk.alive) {
        Walk before = walk;
        before.throughput = before.throughput * transmittance(stack, 1.0f, before.direction);
        walk = before;
        step(stack, 0.0f, walk, random);
        kept.offer(walk, random);
        // The loop skips hits of the coat, because a connection is made only at or after a hit of the conductor.
        if (walk.height >= 1.0f) continue;
        const Vec w_in = -before.direction;
        const float rest = way_in + first;
        // Connects at this hit, as the last hit of the conductor. A path with a single hit is connected there only if
        // `forward` is true, so that it is counted once.
        float blunt = bluntness(sharpness(stack, w_in, drawn_up));
        float share = matched ? 1.0f : blunt / (blunt + rest + blunt_q);
        if (!forward && !(first > 0.0f)) share = 0.0f;
        if (share > 0.0f && drawn_passes > 0.0f) {
            const Vec view = above(w_in);
            const float cosine = dot(view, normalize(view + drawn_up));
            const float weight = share * drawn_passes * mirror_pdf(view, drawn_up, stack.alpha_bottom) *
                                 smith_g1<float>(drawn_up, stack.alpha_bottom, stack.alpha_bottom);
            total = total + before.throughput * conductor(cosine, stack) * weight;
        }
        // Connects at the exit: the light goes up after this hit and is refracted to wo.
        blunt = bluntness(sharpness(stack, w_in, walk.direction));
        if (!matched) {
            const auto [q, t] = out_through_coat(stack, wo, walk.direction);
            if (q > 0.0f && t > 0.0f) {
                share = bluntness(q) / (bluntness(q) + blunt + rest);
                total = total + walk.throughput * (share * q * t * transmittance(stack, 1.0f, walk.direction));
            }
        }
        if (!(first > 0.0f)) first = blunt;
    }
    detour = {kept.direction, kept.tint * kept.total};
    return total;
}

// Estimates the light that scatters in the medium. Every scattering event of `walk` is connected to both of the
// segments `ways`, which belong to a walk from wo.
inline Vec scattered(const Stack& stack, Walk walk, const Way (&ways)[2], Random& random) {
    Vec total{0.0f, 0.0f, 0.0f};
    if (!(stack.sigma_t > 0.0f)) return total;
    while (walk.alive) {
        const Vec arriving = walk.throughput;
        step(stack, stack.sigma_t, walk, random);
        if (!(walk.height > 0.0f && walk.height < 1.0f)) continue;
        Vec out{0.0f, 0.0f, 0.0f};
        for (const Way& way : ways) {
            const Vec& d = way.direction;
            const float depth = d.z < 0.0f ? 1.0f - walk.height : walk.height;
            out = out + way.reached * (transmittance(stack, depth, d) / maximum(absolute(d.z), 1e-7f));
        }
        total = total + arriving * stack.albedo * out * (0.25f * INV_PI<float>);
    }
    return total;
}

// The direction `w` refracted into a flat coat of index `eta` (Snell's law), reversed to point up.
inline Vec refract_flat(const Vec& w, float eta) {
    const float x = w.x / eta, y = w.y / eta;
    return {x, y, sqrt(maximum(1.0f - x * x - y * y, 1e-7f))};
}

}  // namespace detail

// The value f cos(theta_o) [1/sr] of the reflection at the coat's surface alone.
inline float coat_reflection(const Stack& stack, const Vec& wi, const Vec& wo) {
    const Vec m = normalize(wi + wo);
    const float fresnel = std::get<0>(fresnel_dielectric<float>(maximum(dot(wi, m), 0.0f), stack.eta_top));
    const float alpha = stack.alpha_top;
    const float masking = smith_g1<float>(wi, alpha, alpha) * smith_g1<float>(wo, alpha, alpha);
    return fresnel * ggx_d<float>(m, alpha, alpha) * masking / (4.0f * maximum(wi.z, 1e-7f));
}

// One unbiased estimate of f(wi, wo) cos(theta_o) [1/sr], for wi.z > 0 and wo.z > 0.
inline Vec evaluate(const Stack& stack, const Vec& wi, const Vec& wo, Random& random) {
    Walk there = detail::enter(stack, wi, random), back = detail::enter(stack, wo, random);
    there.alive = back.alive = there.alive && back.alive;
    detail::Way unused{}, detour{};
    const Vec forward = detail::unscattered(stack, wi, there, wo, back, random, true, unused);
    const Vec backward = detail::unscattered(stack, wo, back, wi, there, random, false, detour);
    const detail::Way ways[2] = {{back.direction, back.throughput}, detour};
    const Vec through = detail::scattered(stack, there, ways, random);
    const float index2 = stack.eta_top * stack.eta_top;
    return forward + backward * (wo.z / maximum(wi.z, 1e-7f)) + through * (wo.z / index2) +
           coat_reflection(stack, wi, wo);
}

// Simulates one whole walk from `wi` (wi.z > 0). The throughput is 0 if the walk was absorbed. If the walk left the
// material, `direction` is the direction in which it left.
inline Walk walk(const Stack& stack, const Vec& wi, Random& random) {
    Walk made{-wi, {1.0f, 1.0f, 1.0f}, 1.0f, false, true};
    bool left = false;
    while (made.alive) left = detail::step(stack, stack.sigma_t, made, random);
    if (!left) made.throughput = {0.0f, 0.0f, 0.0f};
    return made;
}

// The intermediate results of `pdf` that depend on wi only. `coat`, `bottom` and `diffuse` are the weights of three
// lobes: the coat's reflection, the conductor's reflection seen through the coat, and a cosine lobe. The sum of the
// weights is 1. `width` is the roughness (alpha) of the conductor's lobe, and `inside` is wi refracted into the coat.
struct Density {
    float coat, bottom, diffuse, width;
    Vec inside;

    Density(const Stack& stack, const Vec& wi) : inside(detail::refract_flat(wi, stack.eta_top)) {
        const float eta = stack.eta_top, cos_i = maximum(wi.z, 1e-3f);
        const auto [fresnel, cos_t] = fresnel_dielectric<float>(cos_i, eta);
        const float crossing = stack.alpha_top * (eta * cos_t - cos_i) / (2.0f * eta * cos_t);
        const float width2 = stack.alpha_bottom * stack.alpha_bottom + 2.0f * crossing * crossing;
        const float critical = 1.0f / (eta + safe_sqrt(eta * eta - 1.0f));
        const float trapped = width2 / (width2 + critical * critical);
        const float passes = (1.0f - fresnel) * exp(-2.0f * stack.sigma_t / cos_t);
        bottom = passes * mean(detail::conductor(cos_t, stack));
        diffuse = LEAST_DIFFUSE + 0.5f * ((1.0f - fresnel - passes) * mean(stack.albedo) + bottom * trapped);
        const float norm = 1.0f / (fresnel + bottom + diffuse);
        coat = fresnel * norm;
        bottom *= norm;
        diffuse *= norm;
        width = clip(sqrt(width2), 1e-4f, 1.0f);
    }
};

// A density of wo [1/sr] similar to that of a walk's direction, for importance sampling and for the weights of multiple
// importance sampling. The integral of the density is at most 1, and the density is positive for wo.z > 0.
inline float pdf(const Stack& stack, const Density& density, const Vec& wi, const Vec& wo) {
    if (!(wo.z > 0.0f)) return 0.0f;
    const Vec inside_o = detail::refract_flat(wo, stack.eta_top);
    const float jacobian = wo.z / (stack.eta_top * stack.eta_top * inside_o.z);
    const float mirrored = density.coat * detail::mirror_pdf(detail::above(wi), wo, stack.alpha_top);
    const float seen = density.bottom * detail::mirror_pdf(density.inside, inside_o, density.width) * jacobian;
    return mirrored + seen + density.diffuse * INV_PI<float> * wo.z;
}

// A direction with its density [1/sr]. A density of 0 marks an invalid direction.
struct Drawn {
    Vec wo;
    float pdf;
};

// Draws a direction with density `pdf` from three uniform numbers in [0, 1). The weight of the sample is `evaluate`
// divided by the density, and has more variance than the throughput of a walk. Renderers that combine samples of
// several materials need this function, because they need the exact densities of samples, and the density of a walk is
// unknown.
inline Drawn sample(const Stack& stack, const Density& density, const Vec& wi, float u_lobe, float u1, float u2) {
    Vec wo;
    if (u_lobe < density.coat) {
        wo = sample_spec<float>(detail::above(wi), stack.alpha_top, stack.alpha_top, u1, u2);
    } else if (u_lobe < density.coat + density.bottom) {
        const Vec up = sample_spec<float>(density.inside, density.width, density.width, u1, u2);
        const float x = up.x * stack.eta_top, y = up.y * stack.eta_top, z2 = 1.0f - x * x - y * y;
        wo = {x, y, up.z > 0.0f ? safe_sqrt(z2) : 0.0f};
    } else {
        wo = sample_diffuse<float>(u1, u2);
    }
    return {wo, pdf(stack, density, wi, wo)};
}

// The directional albedo at `wi` (wi.z > 0), at most 1. The albedo is the mean throughput of a fixed set of walks, so
// it has no noise.
inline Vec albedo(const Stack& stack, const Vec& wi, int walks = 256) {
    Vec sum{0.0f, 0.0f, 0.0f};
    for (int k = 0; k < walks; ++k) {
        Random random(static_cast<std::uint64_t>(k), 0);
        sum = sum + walk(stack, wi, random).throughput;
    }
    const float share = 1.0f / static_cast<float>(walks);
    return {minimum(sum.x * share, 1.0f), minimum(sum.y * share, 1.0f), minimum(sum.z * share, 1.0f)};
}

}  // namespace nma::layered
