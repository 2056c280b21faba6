// Signed distances between voxels, exact up to a reach: `_measure_distances` of voxel_crop.py.
//
// Squared distances, axis by axis (Felzenszwalb and Huttenlocher, 2012): along x by two scans, along y and z the least of
// g[i + k] + k^2. Envelopes of parabolas would save steps, but no more than the vectors of these loops do for a short
// reach.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

namespace distances {

// `_Distances` of voxel_kernel.py.
struct Voxels {
    const uint8_t* states;  // (B, X, Y, Z)
    float* distances;       // (B, X, Y, Z) [m]
    int64_t B, X, Y, Z, reach;  // [voxels] beyond which distances are not told apart
    float step, max_distance;   // [m]
    uint8_t occupied;           // the state of the voxels from which distances count
};

// The voxels of one robot. Squares are numbers of type T, at most `far`, of which two must not overflow.
template <class T> class Field {
    static constexpr int64_t W = 32 / sizeof(T);  // numbers at a time
    typedef T Numbers __attribute__((vector_size(32)));
    const Voxels& all;
    const int64_t X, Y, Z, row;  // voxels, and numbers of a padded row along z
    const T reach, far;
    std::vector<T> to_occupied, to_other;  // (X, Y, row)
    std::vector<T> blank, line;            // a row out of reach, and a row between two blank ends
    std::vector<T> nearest[2];             // a row of results each

  public:
    explicit Field(const Voxels& all)
        : all(all), X(all.X), Y(all.Y), Z(all.Z), row((Z + W - 1) / W * W), reach(T(all.reach)),
          far(T(all.reach * all.reach)), to_occupied(X * Y * row), to_other(X * Y * row), blank(row, far),
          line(row + 2 * all.reach, far), nearest{std::vector<T>(row), std::vector<T>(row)} {}

    void measure(int64_t b) {
        start(all.states + b * X * Y * Z);
        float* out = all.distances + b * X * Y * Z;
        for (int64_t x = 0; x < X; x++)
            for (int64_t y = 0; y < Y; y++, out += Z) {
                along_y_and_z(to_occupied, x, y, nearest[0].data());
                along_y_and_z(to_other, x, y, nearest[1].data());
                write(out);
            }
    }

  private:
    // Distances along x, squared.
    void start(const uint8_t* states) {
        for (int64_t k = 0; k < X * Y; k++, states += Z) {
            T *a = &to_occupied[k * row], *b = &to_other[k * row];
            std::fill_n(a, row, reach), std::fill_n(b, row, reach);
            for (int64_t z = 0; z < Z; z++) {
                const bool is_occupied = states[z] == all.occupied;
                a[z] = is_occupied ? 0 : reach, b[z] = is_occupied ? reach : 0;
            }
        }
        for (std::vector<T>* field : {&to_occupied, &to_other}) {
            const int64_t plane = Y * row;
            T* at = field->data();
            for (int64_t x = 1; x < X; x++) step_from(at + x * plane, at + (x - 1) * plane, plane);
            for (int64_t x = X - 2; x >= 0; x--) step_from(at + x * plane, at + (x + 1) * plane, plane);
            for (T& value : *field) value = T(value * value);
        }
    }
    static void step_from(T* __restrict at, const T* __restrict beside, int64_t size) {
        for (int64_t k = 0; k < size; k++) at[k] = std::min(at[k], T(beside[k] + 1));
    }

    void along_y_and_z(const std::vector<T>& field, int64_t x, int64_t y, T* out) {
        const T* plane = &field[x * Y * row];
        T* middle = line.data() + all.reach;
        const auto beside = [&](int64_t at) { return at >= 0 && at < Y ? plane + at * row : blank.data(); };
        for (int64_t z = 0; z < row; z += W)
            lowest(beside(y) + z, Y, middle + z, [&](int64_t k) { return beside(y + k) + z; });
        for (int64_t z = 0; z < row; z += W)
            lowest(middle + z, Z, out + z, [&](int64_t k) { return middle + z + k; });
    }

    // The least of W numbers and those k beside them plus k^2; `beside(k)` are those, along an axis of `size`.
    template <class Beside> void lowest(const T* from, int64_t size, T* out, const Beside& beside) const {
        const auto smaller = [](Numbers a, Numbers b) { return a < b ? a : b; };
        Numbers best = read(from);
        const int64_t farthest = any(best) ? std::min<int64_t>(reach, size - 1) : 0;
        for (int64_t k = 1; k <= farthest; k++)
            best = smaller(best, smaller(read(beside(-k)), read(beside(k))) + T(k * k));
        std::memcpy(out, &best, sizeof best);
    }
    static Numbers read(const T* from) {
        Numbers numbers;
        std::memcpy(&numbers, from, sizeof numbers);
        return numbers;
    }
    static bool any(Numbers numbers) {
        uint64_t words[4];
        std::memcpy(words, &numbers, sizeof words);
        return words[0] | words[1] | words[2] | words[3];
    }

    void write(float* out) const {
        const T *a = nearest[0].data(), *b = nearest[1].data();
        for (int64_t z = 0; z < Z; z++) {
            const int32_t square = int32_t(a[z]) - int32_t(b[z]);  // one of them is 0
            const float d = std::sqrt(float(std::abs(square))) * all.step;
            const float size = std::abs(square) < int32_t(far) ? std::min(d, all.max_distance) : all.max_distance;
            out[z] = square < 0 ? -size : size;
        }
    }
};

}  // namespace distances
