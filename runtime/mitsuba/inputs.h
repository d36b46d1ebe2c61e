// Parameters of a source material as the inputs of a Mitsuba BSDF: a number, a colour or a texture each.
#pragma once

#include <mitsuba/core/logger.h>
#include <mitsuba/core/properties.h>
#include <mitsuba/render/bsdf.h>
#include <mitsuba/render/texture.h>

#include <algorithm>
#include <cmath>

#include "nma/math.h"
#include "nma/weights.h"
#include "texels.h"

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

    // Ranges are those of the parameters: what the material means, or with `trained` what the adapter was trained on. There the
    // property `clamp` moves what lies beyond instead of refusing it. What a texture only knows while rendering (mesh
    // attributes) is moved always.
    Inputs(const Properties& props, const std::vector<SourceParam>& parameters, bool trained) : trained_(trained), clamp_(trained && props.get<bool>("clamp", false)) {
        if (props.has_property("material"))
            Throw("`material` is known in vectorised variants only; give the parameters (`nma materials NAME` shows them, nma.render.load.material_bsdf makes them)");
        for (const SourceParam& p : parameters) {
            Input input{p, nullptr, {0.0f, 0.0f, 0.0f}};
            if (!props.has_property(p.name)) Throw("no value for %s; give it a number, a colour or a texture", p.name);
            read(props, input);
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

    void read(const Properties& props, Input& input) {
        using Type = Properties::Type;
        const SourceParam& p = input.param;
        const Type type = props.type(p.name);
        if (type == Type::Float || type == Type::Integer) {
            input.value = Colour(props.get<Float>(p.name));
        } else if (type == Type::Color) {
            input.value = props.get<Colour>(p.name);
        } else {
            input.texture = props.get_unbounded_texture<Texture>(p.name);
            if (input.texture->is_spatially_varying()) return check(p, *input.texture);
            const SurfaceInteraction3f nowhere = dr::zeros<SurfaceInteraction3f>();
            input.value = Colour(input.texture->eval(nowhere));
            input.texture = nullptr;
        }
        for (int c = 0; c < p.size; ++c) {
            Float& x = input.value[c];
            if (!allowed(p, x)) Throw("%s is %g, %s", p.name, x, range(p));
            x = nma::clip(static_cast<float>(x), low(p), high(p));
        }
    }

    // Refuses textures that hold what is not allowed, or colours where a single number is wanted.
    void check(const SourceParam& p, Texture& texture) const {
        for (const Texels& texels : TexelFinder<Float>(texture).found) {
            const auto& numbers = texels.numbers;
            const auto bad = [&](float x) { return !allowed(p, x); };
            if (const auto first = std::find_if(numbers.begin(), numbers.end(), bad); first != numbers.end()) {
                const std::size_t pixel = static_cast<std::size_t>(first - numbers.begin()) / texels.channels;
                Throw("the texture of %s holds %g at x=%zu, y=%zu, one of %zu such values of %zu; %s", p.name, *first, pixel % texels.width, pixel / texels.width,
                      static_cast<std::size_t>(std::count_if(numbers.begin(), numbers.end(), bad)), numbers.size(), range(p));
            }
            for (std::size_t k = 0; p.size == 1 && k < numbers.size(); ++k)
                if (nma::absolute(numbers[k] - numbers[k - k % texels.channels]) > 1e-6f)
                    Throw("the texture of %s is coloured; a grey one is wanted, for one number per pixel", p.name);
        }
    }

    bool allowed(const SourceParam& p, float x) const {
        const float slack = 1e-6f * nma::maximum(nma::absolute(low(p)), 1.0f);
        return std::isfinite(x) && (clamp_ || (x >= low(p) - slack && x <= high(p) + slack));
    }

    std::string range(const SourceParam& p) const {
        const char* hint = trained_ ? ", the range that the adapter was trained on; set `clamp` to move it there" : "";
        return tfm::format("allowed is %g .. %g%s", p.low, p.high, hint);
    }

    std::vector<Input> inputs_;
    bool trained_, clamp_, textured_ = false;
};

// Registers a plugin for `scalar_rgb` alone: other variants have the Python BSDF of the same name.
#define NMA_EXPORT_SCALAR_PLUGIN(Name)                                                                         \
    template class Name<float, Color<float, 3>>;                                                               \
    extern "C" MI_EXPORT void init_plugin(std::string_view name, PluginRegisterFn add) {                       \
        using Plugin = Name<float, Color<float, 3>>;                                                           \
        add(name, "scalar_rgb", Plugin::Type, [](void*, const Properties& p) -> ref<Object> { return new Plugin(p); }); \
    }

}  // namespace mitsuba::nma_plugin
