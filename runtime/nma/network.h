// The multilayer perceptron: linear layers with ReLU between them, for one query at a time.
#pragma once

#include <vector>

#include "weights.h"

namespace nma {

// Layers of at most this many inputs and outputs run; their numbers live on the stack.
constexpr int WIDEST_LAYER = 512;

// Layers with their matrices transposed, so that one input after the other adds to all neurons at once.
class Network {
public:
    Network() = default;

    explicit Network(const std::vector<Layer>& layers) {
        for (const Layer& layer : layers) {
            if (layer.in > WIDEST_LAYER || layer.out > WIDEST_LAYER)
                throw Error("a layer is wider than " + std::to_string(WIDEST_LAYER) + " neurons");
            const int width = (layer.out + LANES - 1) / LANES * LANES;
            Columns made{layer.in, width, std::vector<float>(static_cast<std::size_t>(layer.in + 1) * width)};
            for (int j = 0; j < layer.out; ++j) {
                made.values[j] = layer.bias[j];
                for (int i = 0; i < layer.in; ++i) made.values[(i + 1) * width + j] = layer.matrix[j * layer.in + i];
            }
            layers_.push_back(std::move(made));
        }
    }

    // `outputs` has room for WIDEST_LAYER numbers, and may hold more than the last layer's after the call.
    void forward(const float* inputs, float* outputs) const {
        alignas(64) float buffers[2][WIDEST_LAYER];
        const float* x = inputs;
        for (std::size_t k = 0; k < layers_.size(); ++k) {
            const bool last = k + 1 == layers_.size();
            float* y = last ? outputs : buffers[k % 2];
            linear(layers_[k], x, y);
            if (!last)
                for (int j = 0; j < layers_[k].width; ++j) y[j] = y[j] > 0.0f ? y[j] : 0.0f;
            x = y;
        }
    }

private:
    static constexpr int LANES = 16;

    // The bias, then one column of the matrix for each input, padded with zeros to whole vectors.
    struct Columns {
        int in, width;
        std::vector<float> values;
    };

    static void linear(const Columns& layer, const float* x, float* y) {
        const float* column = layer.values.data();
        for (int j = 0; j < layer.width; ++j) y[j] = column[j];
        for (int i = 0; i < layer.in; ++i) {
            column += layer.width;
            const float factor = x[i];
            for (int j = 0; j < layer.width; ++j) y[j] += factor * column[j];
        }
    }

    std::vector<Columns> layers_;
};

}  // namespace nma
