// The BRDF for a view direction: a blend, and the frame in which it is evaluated. nma/target/brdf.py is the Python
// version of this code.
#pragma once

#include "blend.h"

namespace nma {

using Direction = Vec3<float>;
using Value = Evaluation<float>;
using Sampled = Sample<float>;

// The BRDF at one shading point. The BRDF is valid only for view directions with the cos(theta_i) that it was prepared
// for. If the adapter is anisotropic, the BRDF is valid only for the `wi` that it was prepared for.
class Brdf {
public:
    // The value f cos(theta_o) [1/sr], which is 0 below the horizon.
    Vec3<float> eval(const Direction& wi, const Direction& wo) const { return eval_pdf(wi, wo).value; }

    // The density [1/sr] with which `sample` draws `wo`, which is 0 below the horizon.
    float pdf(const Direction& wi, const Direction& wo) const { return eval_pdf(wi, wo).pdf; }

    // The value and the density. The call takes no longer than `eval` alone or `pdf` alone.
    Value eval_pdf(const Direction& wi, const Direction& wo) const {
        const Plane<float> plane = frame(wi);
        return nma::eval_pdf(blend_, plane_enter<float>(plane, wi), plane_enter<float>(plane, wo));
    }

    // Draws a direction from three uniform numbers in [0, 1), and returns it with its value and its density. A density
    // of 0 marks an invalid direction.
    Sampled sample(const Direction& wi, float u_lobe, float u1, float u2) const {
        const Plane<float> plane = frame(wi);
        const Direction view = plane_enter<float>(plane, wi);
        const Direction wo = plane_leave<float>(plane, draw(blend_, view, u_lobe, u1, u2));
        // `eval_pdf` computes the same value for `wo`, because the direction is rounded before it enters the frame.
        const Value found = nma::eval_pdf(blend_, view, plane_enter<float>(plane, wo));
        return {wo, found.value, found.pdf};
    }

    // The directional albedo at `wi` as RGB, at most 1, for denoisers. The albedo is the mean of value / pdf over
    // samples at fixed points (Roberts 2018, "R2").
    Vec3<float> albedo(const Direction& wi, int points = 128) const {
        const auto fraction = [](float x) { return x - std::floor(x); };
        Vec3<float> sum{0.0f, 0.0f, 0.0f};
        for (int k = 0; k < points; ++k) {
            const float n = static_cast<float>(k) + 0.5f;
            const Sampled s =
                sample(wi, n / static_cast<float>(points), fraction(n * 0.75487767f), fraction(n * 0.56984029f));
            if (s.pdf > 0.0f) sum = sum + s.value * (1.0f / s.pdf);
        }
        const float share = 1.0f / static_cast<float>(points);
        return {minimum(sum.x * share, 1.0f), minimum(sum.y * share, 1.0f), minimum(sum.z * share, 1.0f)};
    }

    const Blend<float>& blend() const { return blend_; }

private:
    friend class Adapter;
    friend class Curves;

    // The frame in which the blend is evaluated. If the lobes were trained in the plane of incidence, the axes of their
    // anisotropy are in that plane and perpendicular to it. Each call computes the plane from `wi`, because a BRDF that
    // was prepared for a cosine is used for all azimuths. A Python `Brdf` keeps the plane of the `wi` that `prepare`
    // was called with.
    Plane<float> frame(const Direction& wi) const { return in_plane_ ? plane_of<float>(wi) : Plane<float>{1.0f, 0.0f}; }

    Blend<float> blend_;
    bool in_plane_ = false;
};

// The former name of `Brdf`.
using Material = Brdf;

}  // namespace nma
