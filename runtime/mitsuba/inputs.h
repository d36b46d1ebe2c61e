// Parameters of a source material as the inputs of a Mitsuba BSDF: a number, a colour or a texture each.
#pragma once

#include <mitsuba/core/logger.h>
#include <mitsuba/core/properties.h>
#include <mitsuba/render/bsdf.h>
#include <mitsuba/render/texture.h>

#include "nma/math.h"
#include "nma/weights.h"

namespace mitsuba::nma_plugin {

using nma::SourceParam;

// A vector of Mitsuba's for the runtime.
template <class Vector>
nma::Vec3<float> direction(const Vector& v) {
    return {v.x(), v.y(), v.z()};
}

// Whether there is nothing to see: from behind, or with glossy reflection left out.
template <class SurfaceInteraction3f>
bool hidden(const BSDFContext& context, const SurfaceInteraction3f& si) {
    return !(si.wi.z() > 0.0f) || !context.is_enabled(BSDFFlags::GlossyReflection, 0);
}

// One input: a texture, or numbers where there is none.
template <class Float, class Spectrum>
class Inputs {
public:
    MI_IMPORT_TYPES(Texture)

    // Ranges are those of the parameters; with `clamp`, what lies beyond is moved there instead of refused. Textures are
    // only seen while rendering and always moved.
    Inputs(const Properties& props, const std::vector<SourceParam>& parameters, bool clamp) {
        for (const SourceParam& p : parameters) {
            Input input{p, nullptr, {0.0f, 0.0f, 0.0f}};
            if (!props.has_property(p.name)) Throw("no value for %s; give it a number, a colour or a texture", p.name);
            read(props, input, clamp);
            textured_ |= input.texture != nullptr;
            inputs_.push_back(input);
        }
    }

    bool textured() const { return textured_; }

    // Those of a one-sided glossy BSDF with these inputs.
    auto flags() const {
        const auto one_sided = BSDFFlags::GlossyReflection | BSDFFlags::FrontSide;
        return textured_ ? one_sided | BSDFFlags::SpatiallyVarying : one_sided;
    }

    // All parameters at `si`, one after the other.
    void at(const SurfaceInteraction3f& si, float* to) const {
        for (const Input& input : inputs_) {
            const auto limited = [&](Float x) { return input.texture ? nma::clip(static_cast<float>(x), low(input.param), high(input.param)) : static_cast<float>(x); };
            const Colour colour = input.texture ? Colour(input.texture->eval(si)) : input.value;
            for (int c = 0; c < input.param.size; ++c) *to++ = limited(colour[c]);
        }
    }

    std::string to_string() const {
        std::ostringstream text;
        for (const Input& input : inputs_) {
            text << "  " << input.param.name << " = ";
            if (input.texture) text << string::indent(input.texture) << ",\n";
            else if (input.param.size == 1) text << input.value.x() << ",\n";
            else text << input.value << ",\n";
        }
        return text.str();
    }

private:
    using Colour = Color<Float, 3>;

    struct Input {
        SourceParam param;
        ref<Texture> texture;
        Colour value;
    };

    static float low(const SourceParam& p) { return static_cast<float>(p.low); }
    static float high(const SourceParam& p) { return static_cast<float>(p.high); }

    void read(const Properties& props, Input& input, bool clamp) {
        using Type = Properties::Type;
        const SourceParam& p = input.param;
        const Type type = props.type(p.name);
        if (type == Type::Float || type == Type::Integer) {
            input.value = Colour(props.get<Float>(p.name));
        } else if (type == Type::Color) {
            input.value = props.get<Colour>(p.name);
        } else {
            input.texture = props.get_unbounded_texture<Texture>(p.name);
            if (input.texture->is_spatially_varying()) return;
            const SurfaceInteraction3f nowhere = dr::zeros<SurfaceInteraction3f>();
            input.value = Colour(input.texture->eval(nowhere));
            input.texture = nullptr;
        }
        const float slack = 1e-6f * nma::maximum(nma::absolute(low(p)), 1.0f);
        for (int c = 0; c < p.size; ++c) {
            Float& x = input.value[c];
            const bool inside = x >= low(p) - slack && x <= high(p) + slack;
            if (!std::isfinite(x) || !(clamp || inside))
                Throw("%s is %f, allowed is %f .. %f, the range that the adapter was trained on; set `clamp` to move it there", p.name, x, low(p), high(p));
            x = nma::clip(static_cast<float>(x), low(p), high(p));
        }
    }

    std::vector<Input> inputs_;
    bool textured_ = false;
};

// Registers a plugin for `scalar_rgb` alone: other variants have the Python BSDF of the same name.
#define NMA_EXPORT_SCALAR_PLUGIN(Name)                                                                         \
    template class Name<float, Color<float, 3>>;                                                               \
    extern "C" MI_EXPORT void init_plugin(std::string_view name, PluginRegisterFn add) {                       \
        using Plugin = Name<float, Color<float, 3>>;                                                           \
        add(name, "scalar_rgb", Plugin::Type, [](void*, const Properties& p) -> ref<Object> { return new Plugin(p); }); \
    }

}  // namespace mitsuba::nma_plugin
