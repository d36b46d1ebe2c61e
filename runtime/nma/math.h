// The arithmetic that generated/target.h uses: on numbers of type T, which is float, double or `Lanes` (lanes.h), and
// on vectors of three numbers.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <tuple>

namespace nma {

template <class T> constexpr T PI = T(3.14159265358979323846);
template <class T> constexpr T INV_PI = T(1) / PI<T>;

using std::cos;
using std::exp;
using std::log;
using std::sin;
using std::sqrt;

template <class T> inline T minimum(T a, T b) { return b < a ? b : a; }
template <class T> inline T maximum(T a, T b) { return a < b ? b : a; }
template <class T> inline T clip(T x, T low, T high) { return minimum(maximum(x, low), high); }
template <class T> inline T select(bool condition, T a, T b) { return condition ? a : b; }
template <class T> inline T lerp(T a, T b, T t) { return a + (b - a) * t; }
template <class T> inline T absolute(T x) { return x < T(0) ? -x : x; }
template <class T> inline T safe_sqrt(T x) { return x > T(0) ? sqrt(x) : T(0); }

inline std::uint32_t bits(float x) {
    std::uint32_t found;
    std::memcpy(&found, &x, sizeof(found));
    return found;
}
// With -ffast-math, compilers assume that every number is finite, so these functions test the bits of the float.
// Without the sign bit, the bits of infinity are 0x7f800000, and the bits of NaN are larger.
inline bool is_finite(float x) { return (bits(x) & 0x7fffffff) < 0x7f800000; }
inline bool is_nan(float x) { return (bits(x) & 0x7fffffff) > 0x7f800000; }

// A direction or an RGB colour.
template <class T>
struct Vec3 {
    T x, y, z;
};

template <class T> inline Vec3<T> operator+(const Vec3<T>& a, const Vec3<T>& b) {
    return {a.x + b.x, a.y + b.y, a.z + b.z};
}
template <class T> inline Vec3<T> operator-(const Vec3<T>& a, const Vec3<T>& b) {
    return {a.x - b.x, a.y - b.y, a.z - b.z};
}
template <class T> inline Vec3<T> operator-(const Vec3<T>& a) { return {-a.x, -a.y, -a.z}; }
template <class T> inline Vec3<T> operator*(const Vec3<T>& a, const Vec3<T>& b) {
    return {a.x * b.x, a.y * b.y, a.z * b.z};
}
template <class T> inline Vec3<T> operator*(const Vec3<T>& a, T t) { return {a.x * t, a.y * t, a.z * t}; }
template <class T> inline Vec3<T> operator+(const Vec3<T>& a, T t) { return {a.x + t, a.y + t, a.z + t}; }

template <class T> inline T dot(const Vec3<T>& a, const Vec3<T>& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
template <class T> inline Vec3<T> normalize(const Vec3<T>& v) { return v * (T(1) / sqrt(dot(v, v))); }
template <class T> inline T mean(const Vec3<T>& c) { return (c.x + c.y + c.z) * (T(1) / T(3)); }
// The luminance of a colour in linear sRGB (ITU-R BT.709 primaries).
template <class T> inline T luminance(const Vec3<T>& c) {
    return T(0.212671) * c.x + T(0.715160) * c.y + T(0.072169) * c.z;
}

}  // namespace nma
