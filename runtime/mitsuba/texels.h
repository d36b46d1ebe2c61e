// Finds the numbers of a texture that are known before rendering.
#pragma once

#include <drjit/color.h>
#include <drjit/tensor.h>
#include <mitsuba/core/object.h>
#include <mitsuba/core/spectrum.h>

#include <utility>
#include <vector>

namespace mitsuba::nma_plugin {

// An array of pixels, in rows of `width` pixels. Each pixel has `channels` numbers. A single number or colour is one
// pixel.
struct Texels {
    std::vector<float> numbers;
    std::size_t width = 1, channels = 1;
    // Whether Mitsuba stores the pixels as bytes.
    bool bytes = false;

    std::size_t pixels() const { return numbers.size() / channels; }
};

// Finds all arrays, numbers and colours that a texture, or a texture nested in it, exposes to `traverse` under the
// names `data` and `value`.
template <class Float>
class TexelFinder final : public TraversalCallback {
public:
    explicit TexelFinder(Object& texture) { put_object("", &texture, 0); }

    std::vector<Texels> found;
    // Whether the numbers of every texture were found. Mesh attributes, for example, have no numbers before rendering.
    bool complete = true;

protected:
    void put_object(std::string_view, Object* object, uint32_t) override {
        if (!object) return;
        const std::size_t before = found.size();
        Object* const outer = std::exchange(shown_, object);
        object->traverse(this);
        shown_ = outer;
        complete &= found.size() > before;
    }

    void put_value(std::string_view name, void* value, uint32_t, const std::type_info& type) override {
        if (name == "data" &&
            !(pixels<float>(value, type) || pixels<dr::half>(value, type) || pixels<uint8_t>(value, type)))
            Throw("a texture keeps its pixels as %s, which this plugin does not read", type.name());
        if (name != "value") return;
        if (type == typeid(Float)) found.push_back({{static_cast<float>(*static_cast<Float*>(value))}, 1, 1});
        if (type == typeid(Color<Float, 3>)) {
            const auto& c = *static_cast<Color<Float, 3>*>(value);
            found.push_back({{static_cast<float>(c.x()), static_cast<float>(c.y()), static_cast<float>(c.z())}, 1, 3});
        }
    }

private:
    // Stores the pixels of `value` if it is an array (height, width, channels) of numbers of type T. Returns false if
    // `value` is not such an array.
    template <class T>
    bool pixels(void* value, const std::type_info& type) {
        using Tensor = dr::Tensor<dr::DynamicArray<T>>;
        if (type != typeid(Tensor)) return false;
        const auto& tensor = *static_cast<Tensor*>(value);
        Texels texels{{},
                      tensor.ndim() > 1 ? tensor.shape(1) : 1,
                      tensor.ndim() > 2 ? tensor.shape(2) : 1,
                      std::is_same_v<T, uint8_t>};
        // Mitsuba stores the bytes of the image file unchanged. When a texture is evaluated, Mitsuba decodes the bytes
        // from sRGB, unless the texture is `raw`.
        const bool srgb = texels.bytes && shown_->to_string().find("raw = 1") == std::string::npos;
        for (std::size_t k = 0; k < tensor.size(); ++k) {
            float x = static_cast<float>(tensor.array().entry(k));
            if (texels.bytes) x /= 255.0f;
            texels.numbers.push_back(srgb ? dr::srgb_to_linear(x) : x);
        }
        found.push_back(std::move(texels));
        return true;
    }

    Object* shown_ = nullptr;
};

}  // namespace mitsuba::nma_plugin
