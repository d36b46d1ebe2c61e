// Reads weights files, which are safetensors files whose metadata entry `nma` says how to use the network.
// nma/adapter/weights.py is the Python version of this code.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <fstream>
#include <initializer_list>
#include <limits>
#include <tuple>

#include "generated/constants.h"
#include "generated/target.h"
#include "json.h"

namespace nma {

// A linear layer. `matrix` has `out` rows of `in` weights. The last `skipped` inputs of the layer are the inputs of the
// network; the other inputs are the neurons of the layer before.
struct Layer {
    int in = 0, out = 0;
    std::vector<float> matrix, bias;
    int skipped = 0;
};

// A target parameter: a field of `Principled` that the network sets, and the range of its decoded values.
struct TargetParam {
    std::string name;
    int size = 1;
    double low = 0.0, high = 1.0;
    bool logarithmic = false, in_plane = false;
};

// A parameter of the source material, and its training range.
struct SourceParam {
    std::string name;
    int size = 1;
    bool logarithmic = false;
    double low = 0.0, high = 0.0;
    // (x - start) * per_range goes from 0 to 1 over the training range, where x is the parameter, or its natural
    // logarithm if `logarithmic` is true.
    float start = 0.0f, per_range = 1.0f;

    // Whether x is finite and in the range. A number may exceed an end of the range by a rounding error.
    bool allows(float x) const {
        const double slack = ROUNDING * minimum(high - low, 1.0);
        return is_finite(x) && x >= low - slack && x <= high + slack;
    }
    // The number in the range that is nearest to x, or the lower end if x is NaN.
    float clamped(float x) const {
        const float least = static_cast<float>(low);
        return is_nan(x) ? least : clip(x, least, static_cast<float>(high));
    }
};

// Whether x equals `known`, a parameter of a single material, apart from rounding to single precision.
inline bool same(float x, float known) { return is_finite(x) && absolute(x - known) <= SAME * absolute(known) + 1e-8f; }

struct Weights {
    std::string class_name, encoding, dialect;
    std::vector<SourceParam> parameters;
    std::vector<TargetParam> target;
    std::vector<Layer> layers;
    int instances = 0;
    bool directional = false, bounded = false;
    // The parameters of the single material that the network was fitted to. The vector is empty if the network was
    // trained on a class, or if the class has no parameters.
    std::vector<float> material;
    // The indices of two parameters: the width and the index of refraction of the interface under which the target
    // lies. The vector is empty if the target does not lie under an interface.
    std::vector<int> interface;
};

namespace detail {

constexpr int WIDEST = 4096, DEEPEST = 64;
// The largest absolute value that an end of a parameter's range may have.
constexpr double FARTHEST = 1e6;
// Stands for a bound that a parameter does not have.
constexpr double UNBOUNDED = 1e30;
// A double represents every whole number up to this value exactly.
constexpr double MOST_BYTES = 9e15;

// The items of an array of whole numbers. Throws if an item is not a whole number or not in 0 .. limit.
inline std::vector<std::uint64_t> whole(const Json& array, double limit) {
    std::vector<std::uint64_t> found;
    for (const Json& item : array.items) {
        if (item.kind != Json::Kind::Number || !item.whole || !(item.number >= 0 && item.number <= limit))
            throw Error("the header has a size that is negative, too large or not a whole number");
        found.push_back(static_cast<std::uint64_t>(item.number));
    }
    return found;
}

// A tensor of the file: its name, its shape, and its bytes from `first` up to, not including, `last`.
struct Place {
    std::string name;
    std::vector<std::uint64_t> shape;
    std::uint64_t first, last;
};

// Reads the header's entry for a tensor. `size` is the count of bytes of the data of all tensors.
inline Place place(const std::string& name, const Json& entry, std::size_t size) {
    if (entry.kind != Json::Kind::Object) throw Error("the header has no valid entry for tensor " + shown(name));
    if (entry.at("dtype", Json::Kind::String).string != "F32")
        throw Error("tensor " + shown(name) + " is not float32; convert the file or train again");
    const auto range = whole(entry.at("data_offsets", Json::Kind::Array), MOST_BYTES);
    Place made{name, whole(entry.at("shape", Json::Kind::Array), MOST_BYTES), 0, 0};
    std::uint64_t bytes = sizeof(float);
    bool fits = range.size() == 2;
    for (const auto extent : made.shape) {
        fits = fits && (!extent || bytes <= size / extent);
        bytes = fits ? bytes * extent : 0;
    }
    if (!fits || range[1] > size || range[0] > range[1] || range[1] - range[0] != bytes)
        throw Error("tensor " + shown(name) + " does not lie within the file, or its size contradicts its shape");
    made.first = range[0];
    made.last = range[1];
    return made;
}

// The tensors of a file, in the order of their data. Throws if there is a gap between tensors, because a file with a
// gap was damaged or contains unknown data.
inline std::vector<Place> places(const Json& header, std::size_t size) {
    std::vector<Place> made;
    for (std::size_t k = 0; k < header.names.size(); ++k)
        if (header.names[k] != "__metadata__") made.push_back(place(header.names[k], header.items[k], size));
    std::sort(made.begin(), made.end(),
              [](const Place& a, const Place& b) { return std::tie(a.first, a.last) < std::tie(b.first, b.last); });
    std::uint64_t end = 0;
    for (const Place& p : made) {
        if (p.first != end)
            throw Error("tensor " + shown(p.name) +
                        " does not begin where the tensor before it ends; copy the file again or train again");
        end = p.last;
    }
    if (end != size) throw Error("the tensors end before the file does; copy the file again or train again");
    return made;
}

// Returns the numbers of a tensor, and writes its sizes to `shape`. Throws if a number is not finite, or if the tensor
// does not have `dimensions` dimensions.
inline std::vector<float> tensor(const std::vector<Place>& places, const char* data, const std::string& name,
                                 std::size_t dimensions, std::vector<std::uint64_t>& shape) {
    const auto found = std::find_if(places.begin(), places.end(), [&](const Place& p) { return p.name == name; });
    if (found == places.end())
        throw Error("the file lacks tensor " + shown(name) + "; copy the file again or train again");
    shape = found->shape;
    if (shape.size() != dimensions || *std::max_element(shape.begin(), shape.end()) > WIDEST)
        throw Error("tensor " + shown(name) + " has the wrong number of dimensions, or a size above " +
                    std::to_string(WIDEST));
    std::vector<float> values((found->last - found->first) / sizeof(float));
    if (!values.empty()) std::memcpy(values.data(), data + found->first, values.size() * sizeof(float));
    for (const float v : values)
        if (!is_finite(v)) throw Error("tensor " + shown(name) + " holds numbers that are not finite; train again");
    return values;
}

// The layers of the network. If `skip` is true, the last of several layers reads the inputs of the network, too.
inline std::vector<Layer> layers(const std::vector<Place>& places, const char* data, int count, bool skip) {
    std::vector<Layer> made;
    for (int k = 0; k < count; ++k) {
        const std::string name = "layer" + std::to_string(k);
        std::vector<std::uint64_t> shape, length;
        Layer layer;
        layer.matrix = tensor(places, data, name + ".weight", 2, shape);
        layer.bias = tensor(places, data, name + ".bias", 1, length);
        if (skip && k && k + 1 == count) layer.skipped = made.front().in;
        if (length[0] != shape[0] || !shape[0] || !shape[1] ||
            (k && shape[1] != static_cast<std::uint64_t>(made.back().out + layer.skipped)))
            throw Error("layer " + std::to_string(k) + " does not fit the layer before it");
        layer.out = static_cast<int>(shape[0]);
        layer.in = static_cast<int>(shape[1]);
        made.push_back(std::move(layer));
    }
    return made;
}

// The value of the field `name`, which must be a whole number in 1 .. most.
inline int small(const Json& entry, std::string_view name, int most) {
    const Json& found = entry.at(name, Json::Kind::Number);
    const double n = found.number;
    if (!found.whole || !(n >= 1 && n <= most))
        throw Error("in the metadata, '" + std::string(name) + "' is not a whole number in 1 .. " +
                    std::to_string(most));
    return static_cast<int>(n);
}

// The value of the field `name`, which must be true or false. The value is false if the field is missing.
inline bool flag(const Json& entry, std::string_view name) {
    return entry.find(name) && entry.at(name, Json::Kind::Boolean).boolean;
}

// The values of the fields `low` and `high`. These values are finite, because JSON has no infinity, and `Json::parse`
// rejects numbers that are too large for a double.
inline std::pair<double, double> range(const Json& entry) {
    return {entry.at("low", Json::Kind::Number).number, entry.at("high", Json::Kind::Number).number};
}

// Throws if `entry` has a field that is not `known`. An unknown field may change the meaning of the other fields.
inline void only(const Json& entry, std::initializer_list<std::string_view> known) {
    for (const std::string& name : entry.names)
        if (std::find(known.begin(), known.end(), name) == known.end())
            throw Error("the metadata has the unknown field '" + shown(name) + "'; upgrade the runtime or train again");
}

// The value of the field `name`, or `without` if the field is null or missing.
inline double bound(const Json& entry, std::string_view name, double without) {
    const Json* found = entry.find(name);
    return found && found->kind != Json::Kind::Null ? entry.at(name, Json::Kind::Number).number : without;
}

inline SourceParam source_param(const Json& entry) {
    SourceParam p;
    p.name = entry.at("name", Json::Kind::String).string;
    p.size = small(entry, "size", 64);
    p.logarithmic = entry.at("law", Json::Kind::String).string == "log10";
    std::tie(p.low, p.high) = range(entry);
    if (!(-FARTHEST <= p.low && p.low <= p.high && p.high <= FARTHEST) || (p.logarithmic && !(p.low > 0)))
        throw Error("parameter '" + shown(p.name) + "' has no valid range");
    if (p.low < p.high) {
        p.start = static_cast<float>(p.logarithmic ? std::log(p.low) : p.low);
        p.per_range = static_cast<float>(1.0 / (p.logarithmic ? std::log(p.high / p.low) : p.high - p.low));
    }
    return p;
}

// The field of `Principled` that is called `name` and has `size` numbers.
inline const Field& field(const std::string& name, int size) {
    for (const Field& f : FIELDS)
        if (f.name == name && f.size == size) return f;
    throw Error("unknown target parameter '" + shown(name) + "'; upgrade the runtime");
}

inline TargetParam target_param(const Json& entry) {
    TargetParam p;
    only(entry, {"name", "size", "low", "high", "scale", "in_plane"});
    p.name = entry.at("name", Json::Kind::String).string;
    p.size = small(entry, "size", 3);
    std::tie(p.low, p.high) = range(entry);
    const std::string& scale = entry.at("scale", Json::Kind::String).string;
    p.logarithmic = scale == "log";
    p.in_plane = flag(entry, "in_plane");
    const Field& known = field(p.name, p.size);
    if (!(known.low <= p.low && p.low < p.high && p.high <= known.high) || (p.logarithmic && !(p.low > 0)))
        throw Error("target parameter '" + shown(p.name) + "' has no valid range");
    if (!p.logarithmic && scale != "linear")
        throw Error("target parameter '" + shown(p.name) + "' has the unknown scale '" + shown(scale) + "'");
    if (p.in_plane && p.name != "anisotropic")
        throw Error("target parameter '" + shown(p.name) +
                    "' has the flag in_plane, which only 'anisotropic' may have");
    return p;
}

// All parameters of the target.
inline std::vector<TargetParam> target_params(const Json& about) {
    std::vector<TargetParam> found;
    bool colour = false, twice = false;
    for (const Json& entry : about.at("target", Json::Kind::Array).items) {
        const TargetParam p = target_param(entry);
        colour |= p.name == "base_color";
        for (const TargetParam& other : found) twice |= other.name == p.name;
        found.push_back(p);
    }
    if (!colour || twice) throw Error("target parameters must have a base_color, and no name twice");
    return found;
}

// The parameters of the single material that the network was fitted to, from the file's record of its training. The
// result is empty if the network reads parameters, or if the file has no record of a material.
inline std::vector<float> material(const Json& about, const Weights& made) {
    // For each number of the material: its parameter, with the range that the class's source accepts.
    std::vector<SourceParam> valid;
    for (std::size_t k = 0; k < made.parameters.size(); ++k) {
        const Json& entry = about.at("parameters", Json::Kind::Array).items[k];
        SourceParam p = made.parameters[k];
        p.low = bound(entry, "valid_low", -UNBOUNDED);
        p.high = bound(entry, "valid_high", UNBOUNDED);
        valid.insert(valid.end(), static_cast<std::size_t>(p.size), p);
    }
    const std::size_t size = valid.size();
    const Json* training = about.find("training");
    if (training) about.at("training", Json::Kind::Object);
    const Json* fitted = training ? training->find("params") : nullptr;
    if (!fitted || fitted->kind == Json::Kind::Null || !size ||
        (made.encoding != "direction" && made.encoding != "azimuth"))
        return {};
    std::vector<float> found;
    if (fitted->kind == Json::Kind::Array)
        for (const Json& item : fitted->items) {
            if (item.kind != Json::Kind::Number || absolute(item.number) > UNBOUNDED || found.size() == size) break;
            const float x = static_cast<float>(item.number);
            if (!valid[found.size()].allows(x)) break;
            found.push_back(x);
        }
    if (found.size() != size || fitted->items.size() != size)
        throw Error("the recorded material does not fit the class " + shown(made.class_name) +
                    "; fit the adapter again");
    return found;
}

// The index of the parameter `name`, a single number, in an array of all parameters. Throws if the parameter does not
// exist or may be less than `least`.
inline int interface_column(const Weights& made, const std::string& name, double least) {
    int column = 0;
    for (const SourceParam& p : made.parameters) {
        if (p.name == name && p.size == 1 && (made.material.empty() ? p.low : made.material[column]) >= least)
            return column;
        column += p.size;
    }
    throw Error("the interface needs a width above 0 and an index of at least 1, but '" + shown(name) +
                "' is no such parameter; train again");
}

// The indices of the interface's width and index of refraction in an array of all parameters. The result is empty if
// the target does not lie under an interface.
inline std::vector<int> interface_columns(const Json& about, const Weights& made) {
    std::vector<std::string> names;
    if (about.find("interface"))
        for (const Json& name : about.at("interface", Json::Kind::Array).items) names.push_back(name.string);
    if (names.empty()) {
        for (const TargetParam& p : made.target)
            if (p.name == "veil" || p.name == "shift")
                throw Error("the target lies under an interface, which the file does not name; train again");
        return {};
    }
    if (names.size() != 2) throw Error("the interface needs the names of two parameters; train again");
    constexpr double TINY = std::numeric_limits<float>::min();
    return {interface_column(made, names[0], TINY), interface_column(made, names[1], 1.0)};
}

inline Weights weights(const char* bytes, std::size_t size) {
    std::uint64_t length = 0;
    if (size < 8) throw Error("the file is too short for a weights file");
    for (int k = 7; k >= 0; --k) length = length << 8 | static_cast<unsigned char>(bytes[k]);
    if (length > size - 8)
        throw Error("the file is truncated, or not a safetensors file; copy the file again or train again");
    const Json header = Json::parse({bytes + 8, static_cast<std::size_t>(length)});
    const Json& metadata = header.at("__metadata__", Json::Kind::Object);
    const Json about = Json::parse(metadata.at("nma", Json::Kind::String).string);
    const Json& format = about.at("format", Json::Kind::Number);
    if (!format.whole || format.number != FORMAT)
        throw Error("the file has a format that this version does not read; upgrade the runtime");
    only(about, {"class_name", "parameters", "encoding", "hidden", "instances", "directional", "reciprocal", "dialect",
                 "target", "bounded", "training", "format", "interface", "skip"});
    about.at("reciprocal", Json::Kind::Boolean);
    Weights made;
    made.class_name = about.at("class_name", Json::Kind::String).string;
    made.encoding = about.at("encoding", Json::Kind::String).string;
    made.dialect = about.at("dialect", Json::Kind::String).string;
    made.directional = about.at("directional", Json::Kind::Boolean).boolean;
    made.bounded = flag(about, "bounded");
    for (const Json& entry : about.at("parameters", Json::Kind::Array).items)
        made.parameters.push_back(source_param(entry));
    made.target = target_params(about);
    made.material = material(about, made);
    made.interface = interface_columns(about, made);
    made.instances = small(about, "instances", 64);
    const auto hidden = whole(about.at("hidden", Json::Kind::Array), WIDEST);
    if (hidden.size() >= DEEPEST) throw Error("the network has too many layers");
    const char* data = bytes + 8 + length;
    made.layers = layers(places(header, size - 8 - static_cast<std::size_t>(length)), data,
                         static_cast<int>(hidden.size()) + 1, flag(about, "skip"));
    for (std::size_t k = 0; k < hidden.size(); ++k)
        if (static_cast<std::uint64_t>(made.layers[k].out) != hidden[k])
            throw Error("the hidden layers do not have the widths in the metadata");
    return made;
}

}  // namespace detail

// Parses the bytes of a weights file. Throws `Error` if the bytes are not a valid weights file.
inline Weights parse_weights(const void* bytes, std::size_t size) {
    return detail::weights(static_cast<const char*>(bytes), size);
}

// Returns the bytes of a file. Throws `Error` if the file cannot be read.
inline std::string read_file(const std::string& path) {
    std::ifstream file(path, std::ios::binary);
    std::string bytes;
    // A folder, or a file on a broken disk, can be opened but not read. For such a file, `read` reports a failure,
    // whereas stream iterators would throw an exception that is not an `Error`.
    for (char block[1 << 14]; file.read(block, sizeof block), file.gcount() > 0;)
        bytes.append(block, static_cast<std::size_t>(file.gcount()));
    if (!file.eof()) throw Error("no such weights file, or it cannot be read");
    return bytes;
}

}  // namespace nma
