// The inputs of a Mitsuba BSDF for a source material. Each parameter of the material is an input: a number, a colour or
// a texture.
#pragma once

#include <mitsuba/core/logger.h>
#include <mitsuba/core/properties.h>
#include <mitsuba/render/bsdf.h>
#include <mitsuba/render/texture.h>

#include <algorithm>

#include "nma/math.h"
#include "nma/weights.h"
#include "texels.h"

namespace mitsuba::nma_plugin {

using nma::SourceParam;

// One input: a texture, or numbers.
template <class Float, class Spectrum>
struct Input {
    MI_IMPORT_TYPES(Texture)
    using Colour = Color<Float, 3>;

    SourceParam param;
    ref<Texture> texture;
    // `shown` holds the numbers that `mi.traverse` returns. `value` holds the numbers of the last check, clamped to the
    // range of the parameter. If a texture object is shared, another owner may edit the texture without a call to this
    // input, and then `value` is out of date.
    Colour value, shown;
    // For a parameter of one number: the index of the texture channel that the parameter reads, or -1 if no channel was
    // chosen.
    int channel = -1;
    // Whether all numbers of the texture are known before rendering.
    bool known = false;

    // Whether the input may differ between points of the surface. A texture whose numbers are not known before
    // rendering, such as a mesh attribute, may differ even if Mitsuba's `is_spatially_varying` returns false.
    bool varies() const { return texture && (!known || texture->is_spatially_varying()); }
    // Whether the input is a texture that is the same at all points. Other objects of the scene may use the same
    // texture object.
    bool shared() const { return texture && !varies(); }

    // The numbers of the texture at `si`, which are not checked.
    Colour looked_up(const SurfaceInteraction3f& si) const {
        const Colour colour = Colour(texture->eval(si));
        return param.size == 1 ? Colour(colour[std::max(channel, 0)]) : colour;
    }
};

template <class Float, class Spectrum>
class Inputs {
public:
    MI_IMPORT_TYPES(Texture)
    using Input = nma_plugin::Input<Float, Spectrum>;
    using Colour = typename Input::Colour;

    // Reads one input for each of `parameters` from the properties, and checks the input against the range of the
    // parameter. `trained` says whether the ranges are training ranges. For training ranges, the property `clamp` moves
    // numbers into the range instead of rejecting them. Numbers that are known only during rendering (mesh attributes)
    // are always moved into the range.
    Inputs(const Properties& props, const std::vector<SourceParam>& parameters, bool trained)
        : trained_(trained), clamp_(trained && props.get<bool>("clamp", false)) {
        if (props.has_property("material"))
            Throw(
                "only vectorised variants have the property `material`; give the parameters instead, which "
                "`nma materials NAME` prints and nma.render.load.material_bsdf returns");
        for (const SourceParam& p : parameters) {
            if (!props.has_property(p.name)) Throw("no value for %s; give it a number, a colour or a texture", p.name);
            inputs_.push_back(read(props, p));
            inputs_.back().channel = channel(props, inputs_.back());
            accept(inputs_.back());
            any_shared_ |= inputs_.back().shared();
        }
    }

    // Whether any input may differ between points of the surface.
    bool textured() const {
        return std::any_of(inputs_.begin(), inputs_.end(), [](const Input& input) { return input.varies(); });
    }

    // The flags of the BSDF, which is glossy and reflects on the front side only.
    auto flags() const {
        const auto one_sided = BSDFFlags::GlossyReflection | BSDFFlags::FrontSide;
        return textured() ? one_sided | BSDFFlags::SpatiallyVarying : one_sided;
    }

    // Writes the numbers of all parameters at `si`, one after the other. After a rejected edit, this function throws
    // until another edit is accepted.
    void at(const SurfaceInteraction3f& si, float* to) const {
        if (!fault_.empty()) Throw("%s", fault_);
        for (const Input& input : inputs_) {
            const Colour colour = at(input, si);
            for (int c = 0; c < input.param.size; ++c) *to++ = static_cast<float>(colour[c]);
        }
    }

    // Whether all inputs that are the same at all points still have the values that were checked.
    bool unchanged(const SurfaceInteraction3f& si) const {
        return !any_shared_ || std::all_of(inputs_.begin(), inputs_.end(), [&](const Input& input) {
            return !input.shared() || dr::all(at(input, si) == input.value);
        });
    }

    void traverse(TraversalCallback* callback) {
        for (Input& input : inputs_) {
            if (input.texture) callback->put(input.param.name, input.texture, ParamFlags::NonDifferentiable);
            else if (input.param.size == 1)
                callback->put(input.param.name, input.shown.x(), ParamFlags::NonDifferentiable);
            else callback->put(input.param.name, input.shown, ParamFlags::NonDifferentiable);
        }
    }

    // Checks all inputs after an edit.
    void changed() {
        try {
            for (Input& input : inputs_) accept(input);
            fault_.clear();
        } catch (const std::exception& e) {
            fault_ = e.what();
            throw;
        }
    }

    const Input* find(std::string_view name) const {
        const auto found =
            std::find_if(inputs_.begin(), inputs_.end(), [&](const Input& input) { return input.param.name == name; });
        return found == inputs_.end() ? nullptr : &*found;
    }

    // The one or three numbers of an input at `si`, within the range of the parameter.
    Colour at(const Input& input, const SurfaceInteraction3f& si) const {
        if (!input.texture) return input.value;
        const Colour colour = input.looked_up(si);
        for (int c = 0; input.known && c < input.param.size; ++c)
            if (!allowed(input.param, colour[c]))
                Throw("the texture of %s: %s", input.param.name, refusal(input.param, colour));
        return within(input.param, colour);
    }

    std::string to_string() const {
        std::ostringstream text;
        for (const Input& input : inputs_) {
            text << "  " << input.param.name << " = ";
            if (input.texture) text << string::indent(input.texture) << ",\n";
            else if (input.param.size == 1) text << input.shown.x() << ",\n";
            else text << input.shown << ",\n";
        }
        return text.str();
    }

private:
    static Colour within(const SourceParam& p, const Colour& colour) {
        return {p.clamped(static_cast<float>(colour.x())), p.clamped(static_cast<float>(colour.y())),
                p.clamped(static_cast<float>(colour.z()))};
    }

    static Input read(const Properties& props, const SourceParam& p) {
        using Type = Properties::Type;
        Input input{p, nullptr, Colour(0.0f), Colour(0.0f)};
        const Type type = props.type(p.name);
        if (type == Type::Float || type == Type::Integer) {
            input.shown = Colour(props.get<Float>(p.name));
            return input;
        }
        if (type == Type::Color) {
            input.shown = props.get<Colour>(p.name);
        } else if (type == Type::Vector) {
            const auto numbers = props.get<Vector3f>(p.name);
            input.shown = Colour(numbers.x(), numbers.y(), numbers.z());
        } else {
            input.texture = props.get_unbounded_texture<Texture>(p.name);
            if (type != Type::Spectrum) return input;
            input.shown = Colour(input.texture->eval(dr::zeros<SurfaceInteraction3f>()));
            input.texture = nullptr;
        }
        const Colour& c = input.shown;
        if (p.size == 1 && (c.x() != c.y() || c.x() != c.z()))
            Throw("%s needs one number or a texture, got the colour %g, %g, %g", p.name, c.x(), c.y(), c.z());
        return input;
    }

    // The index of the texture channel that the property NAME_channel chooses, or -1 without this property.
    static int channel(const Properties& props, const Input& input) {
        const std::string name = input.param.name + "_channel";
        if (!props.has_property(name)) return -1;
        const std::string wanted(props.get<std::string_view>(name));
        if (!input.texture || input.param.size > 1)
            Throw("%s chooses a channel of a texture, but %s has %s; leave %s out", name, input.param.name,
                  input.texture ? "more than one number" : "no texture", name);
        const auto place = std::string_view("rgb").find(wanted);
        if (wanted.size() != 1 || place == std::string_view::npos) Throw("%s is '%s'; choose r, g or b", name, wanted);
        return static_cast<int>(place);
    }

    // Checks the numbers of the input, and stores them in `input.value`. Throws if a number is not allowed.
    void accept(Input& input) const {
        const SourceParam& p = input.param;
        if (input.texture) {
            const TexelFinder<Float> finder(*input.texture);
            input.known = finder.complete;
            for (const Texels& texels : finder.found) check(input, texels);
            if (input.shared()) input.value = at(input, dr::zeros<SurfaceInteraction3f>());
            return;
        }
        for (int c = 0; c < p.size; ++c)
            if (!allowed(p, input.shown[c])) Throw("%s", refusal(p, input.shown));
        input.value = within(p, input.shown);
    }

    // Throws if a pixel has a number that is not allowed. Throws also if the pixels are coloured, the parameter has one
    // number, and no channel was chosen.
    void check(const Input& input, const Texels& texels) const {
        const SourceParam& p = input.param;
        const auto& numbers = texels.numbers;
        const bool coloured = texels.channels >= 3, one = coloured && input.channel >= 0;
        if (p.size == 1 && coloured && !one && !grey(texels))
            Throw(
                "the texture of %s is coloured, and %s is one number per pixel; choose a channel: set `%s_channel` to "
                "r, g or b",
                p.name, p.name, p.name);
        std::size_t first = numbers.size(), last = numbers.size(), bad = 0;
        const std::size_t start = one ? static_cast<std::size_t>(input.channel) : 0, step = one ? texels.channels : 1;
        for (std::size_t k = start; k < numbers.size(); k += step)
            if (!allowed(p, numbers[k]) && k / texels.channels != last) {
                last = k / texels.channels;
                if (bad++ == 0) first = k;
            }
        if (!bad) return;
        const std::size_t pixel = first / texels.channels;
        const auto* at = &numbers[pixel * texels.channels];
        const Colour found = coloured && p.size == 3 ? Colour(at[0], at[1], at[2]) : Colour(numbers[first]);
        std::string place =
            texels.pixels() > 1 ? tfm::format(" at x=%zu, y=%zu", pixel % texels.width, pixel / texels.width) : "";
        if (bad > 1) place += tfm::format(", the first of %zu such pixels", bad);
        const char* hint = texels.bytes ? "; the pixels are stored as bytes, which hold only 0 to 1; with `format` "
                                          "\"variant\" a bitmap keeps floats, which can be edited"
                                        : "";
        Throw("the texture of %s%s: %s%s", p.name, place, refusal(p, found), hint);
    }

    // Whether the channels of each pixel are equal up to rounding: the largest minus the smallest channel is at most
    // ROUNDING, or ROUNDING times the red value if the red value is above 1. The Python version is `is_coloured` in
    // nma/materials/texture.py, which returns the opposite.
    static bool grey(const Texels& texels) {
        const auto end = texels.numbers.end();
        for (auto red = texels.numbers.begin(); red != end; red += static_cast<std::ptrdiff_t>(texels.channels)) {
            const auto ends = std::minmax_element(red, red + static_cast<std::ptrdiff_t>(texels.channels));
            const float spread = *ends.second - *ends.first;
            if (spread > nma::ROUNDING * nma::maximum(nma::absolute(*red), 1.0f)) return false;
        }
        return true;
    }

    bool allowed(const SourceParam& p, Float x) const {
        const float number = static_cast<float>(x);
        return nma::is_finite(number) && (clamp_ || p.allows(number));
    }

    // The error message for a value that is not allowed. `Bounds.refusal` in nma/params.py makes the same message.
    std::string refusal(const SourceParam& p, const Colour& found) const {
        const auto text = [](Float x) { return tfm::format("%.7g", x); };
        const std::string x = text(found.x()), y = text(found.y()), z = text(found.z());
        const bool grey = p.size == 1 || (x == y && x == z);
        const char* advice = trained_ ? ", the range that the adapter was trained on; set `clamp` to clamp such values"
                                      : "; choose a value within this range";
        return tfm::format("%s is %s, allowed is %g .. %g%s", p.name, grey ? x : x + ", " + y + ", " + z, p.low, p.high,
                           advice);
    }

    std::vector<Input> inputs_;
    bool trained_, clamp_, any_shared_ = false;
    std::string fault_;
};

}  // namespace mitsuba::nma_plugin
