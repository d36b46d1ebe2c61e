// The weights file: safetensors whose metadata entry `nma` says how to use the network. Twin of nma/weights.py.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#include <fstream>
#include <iterator>

#include "json.h"

namespace nma {

// A linear layer: `matrix` is (out, in) by rows.
struct Layer {
    int in = 0, out = 0;
    std::vector<float> matrix, bias;
};

// A field of `Principled` that the network sets, with the range of its decoded values.
struct TargetParam {
    std::string name;
    int size = 1;
    double low = 0.0, high = 1.0;
    bool logarithmic = false, in_plane = false;
};

// A parameter of the source material with its training range.
struct SourceParam {
    std::string name;
    int size = 1;
    bool logarithmic = false;
    double low = 0.0, high = 0.0;  // 0 where the file states none
    // (value - start) per_range lies in 0 .. 1 over the range, of the logarithm for a logarithmic one.
    float start = 0.0f, per_range = 1.0f;
};

struct Weights {
    std::string class_name, encoding, dialect;
    std::vector<SourceParam> parameters;
    std::vector<TargetParam> target;
    std::vector<Layer> layers;
    int instances = 0;
    bool directional = false, bounded = false;
};

namespace detail {

constexpr int FORMAT = 1;
constexpr int WIDEST = 4096, DEEPEST = 64;

// The whole numbers of an array, each in 0 .. limit.
inline std::vector<std::uint64_t> whole(const Json& array, double limit) {
    std::vector<std::uint64_t> found;
    for (const Json& item : array.items) {
        if (item.kind != Json::Kind::Number || !(item.number >= 0 && item.number <= limit) || item.number != std::floor(item.number))
            throw Error("its header has a size that makes no sense");
        found.push_back(static_cast<std::uint64_t>(item.number));
    }
    return found;
}

// The tensor `name` as floats, of which `shape` tells the sizes.
inline std::vector<float> tensor(const Json& header, const char* data, std::size_t size, const std::string& name, std::vector<std::uint64_t>& shape) {
    const Json& entry = header.at(name, Json::Kind::Object);
    if (entry.at("dtype", Json::Kind::String).string != "F32") throw Error("tensor " + name + " is not float32");
    shape = whole(entry.at("shape", Json::Kind::Array), WIDEST);
    const auto range = whole(entry.at("data_offsets", Json::Kind::Array), 9e15);
    std::uint64_t count = 1;
    for (const auto extent : shape) count *= extent;
    if (shape.empty() || shape.size() > 2 || range.size() != 2 || range[1] > size || range[0] > range[1] || range[1] - range[0] != 4 * count)
        throw Error("tensor " + name + " does not lie within the file, or its size contradicts its shape");
    std::vector<float> values(count);
    if (count) std::memcpy(values.data(), data + range[0], 4 * count);
    for (const float v : values)
        if (!std::isfinite(v)) throw Error("tensor " + name + " holds numbers that are not finite; train again");
    return values;
}

inline std::vector<Layer> layers(const Json& header, const char* data, std::size_t size, int count) {
    std::vector<Layer> made;
    for (int k = 0; k < count; ++k) {
        const std::string name = "layer" + std::to_string(k);
        std::vector<std::uint64_t> shape, length;
        Layer layer;
        layer.matrix = tensor(header, data, size, name + ".weight", shape);
        layer.bias = tensor(header, data, size, name + ".bias", length);
        if (shape.size() != 2 || length.size() != 1 || length[0] != shape[0] || !shape[0] || !shape[1] ||
            (k && shape[1] != static_cast<std::uint64_t>(made.back().out)))
            throw Error("layer " + std::to_string(k) + " does not fit the one before it");
        layer.out = static_cast<int>(shape[0]);
        layer.in = static_cast<int>(shape[1]);
        made.push_back(std::move(layer));
    }
    return made;
}

inline double number_or_zero(const Json& entry, std::string_view name) {
    const Json* found = entry.find(name);
    return found && found->kind == Json::Kind::Number ? found->number : 0.0;
}

inline int small(const Json& entry, std::string_view name, int most) {
    const double n = entry.at(name, Json::Kind::Number).number;
    if (!(n >= 1 && n <= most) || n != std::floor(n)) throw Error("its metadata has a senseless '" + std::string(name) + "'");
    return static_cast<int>(n);
}

inline bool flag(const Json& entry, std::string_view name) {
    const Json* found = entry.find(name);
    return found && found->kind == Json::Kind::Boolean && found->boolean;
}

inline SourceParam source_param(const Json& entry) {
    SourceParam p;
    p.name = entry.at("name", Json::Kind::String).string;
    p.size = small(entry, "size", 64);
    p.logarithmic = entry.at("law", Json::Kind::String).string == "log10";
    p.low = number_or_zero(entry, "low");
    p.high = number_or_zero(entry, "high");
    if (p.logarithmic && !(p.low > 0)) throw Error("parameter '" + p.name + "' has no valid range");
    if (p.low < p.high) {
        p.start = static_cast<float>(p.logarithmic ? std::log(p.low) : p.low);
        p.per_range = static_cast<float>(1.0 / (p.logarithmic ? std::log(p.high / p.low) : p.high - p.low));
    }
    return p;
}

inline TargetParam target_param(const Json& entry) {
    TargetParam p;
    p.name = entry.at("name", Json::Kind::String).string;
    p.size = small(entry, "size", 3);
    p.low = entry.at("low", Json::Kind::Number).number;
    p.high = entry.at("high", Json::Kind::Number).number;
    p.logarithmic = entry.at("scale", Json::Kind::String).string == "log";
    p.in_plane = flag(entry, "in_plane");
    if (!(p.low < p.high) || (p.logarithmic && !(p.low > 0))) throw Error("target parameter '" + p.name + "' has no valid range");
    return p;
}

inline Weights weights(const char* bytes, std::size_t size) {
    std::uint64_t length = 0;
    if (size < 8) throw Error("too short for a weights file");
    for (int k = 7; k >= 0; --k) length = length << 8 | static_cast<unsigned char>(bytes[k]);
    if (length > size - 8) throw Error("truncated, or not a safetensors file; copy or train it again");
    const Json header = Json::parse({bytes + 8, static_cast<std::size_t>(length)});
    const Json& metadata = header.at("__metadata__", Json::Kind::Object);
    const Json about = Json::parse(metadata.at("nma", Json::Kind::String).string);
    if (about.at("format", Json::Kind::Number).number != FORMAT) throw Error("another format than this version reads; upgrade the runtime");
    Weights made;
    made.class_name = about.at("class_name", Json::Kind::String).string;
    made.encoding = about.at("encoding", Json::Kind::String).string;
    made.dialect = about.at("dialect", Json::Kind::String).string;
    made.directional = flag(about, "directional");
    made.bounded = flag(about, "bounded");
    for (const Json& entry : about.at("parameters", Json::Kind::Array).items) made.parameters.push_back(source_param(entry));
    for (const Json& entry : about.at("target", Json::Kind::Array).items) made.target.push_back(target_param(entry));
    made.instances = small(about, "instances", 64);
    const auto hidden = whole(about.at("hidden", Json::Kind::Array), WIDEST);
    if (hidden.size() >= DEEPEST) throw Error("a network of too many layers");
    made.layers = layers(header, bytes + 8 + length, size - 8 - static_cast<std::size_t>(length), static_cast<int>(hidden.size()) + 1);
    for (std::size_t k = 0; k < hidden.size(); ++k)
        if (static_cast<std::uint64_t>(made.layers[k].out) != hidden[k]) throw Error("its hidden layers are not those of its metadata");
    return made;
}

}  // namespace detail

// The contents of a weights file in memory. Throws `Error`.
inline Weights parse_weights(const void* bytes, std::size_t size) { return detail::weights(static_cast<const char*>(bytes), size); }

// The bytes of a file. Throws `Error`.
inline std::string read_file(const std::string& path) {
    std::ifstream file(path, std::ios::binary);
    if (!file) throw Error("no such weights file, or it cannot be read");
    return {std::istreambuf_iterator<char>(file), {}};
}

}  // namespace nma
