// Rows of a surfel and their products, as skindb/reflectance/_row_kernels.py and
// _mixture_kernels.gram compute them: the measured prototype of a C++ extension.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

namespace {

constexpr int CHUNK = 64;
constexpr int WIDTH = 24;  // rank 16 and eight lobes
constexpr int ROWS_PER_SUM = 256;
constexpr float PI = 3.14159265358979f;

inline float arctangent(float y, float x) {  // x, y >= 0; error 2.5e-7
    const float large = std::max(std::max(x, y), 1e-30f);
    const float t = std::min(x, y) / large;
    const float q = t * t;
    float total = 0.00681179190956116f;
    total = total * q - 0.03360421818567151f;
    total = total * q + 0.07962367280685324f;
    total = total * q - 0.1323334239985408f;
    total = total * q + 0.19807815771352963f;
    total = total * q - 0.3331736810442645f;
    total = total * q + 0.9999961115845969f;
    return y > x ? 0.5f * PI - t * total : t * total;
}

struct Cells {
    float way[6][CHUNK];
    float share[8][CHUNK];
    int32_t corner[2][CHUNK];
};

void write_cells(const float* n, int count, const int32_t* shape, Cells& c) {
    const float per_h = std::sqrt(2.0f / PI) * (shape[0] - 1);
    const float per_d = 2.0f / PI * (shape[1] - 1);
    const float per_phi = shape[2] / PI;
    const int nd = shape[1], last_h = shape[0] - 2, last_d = shape[1] - 2, n_phi = shape[2];
    for (int q = 0; q < count; ++q) {
        const float ix = c.way[0][q], iy = c.way[1][q], iz = c.way[2][q];
        const float ox = c.way[3][q], oy = c.way[4][q], oz = c.way[5][q];
        const float hx = ix + ox, hy = iy + oy, hz = iz + oz;
        const float bx = n[1] * hz - n[2] * hy, by = n[2] * hx - n[0] * hz,
                    bz = n[0] * hy - n[1] * hx;
        const float sin_h = std::sqrt(bx * bx + by * by + bz * bz);
        const float lit = n[0] * ix + n[1] * iy + n[2] * iz;
        const float seen = n[0] * ox + n[1] * oy + n[2] * oz;
        const float theta_h = arctangent(sin_h, std::max(lit + seen, 0.0f));
        const float both = ix * ox + iy * oy + iz * oz;
        const float near = std::sqrt(std::max(1.0f + both, 1e-30f));
        const float far = std::sqrt(std::max(1.0f - both, 0.0f));
        const float theta_d = arctangent(far, near);
        const float side = (n[0] * (oy * iz - oz * iy) + n[1] * (oz * ix - ox * iz) +
                            n[2] * (ox * iy - oy * ix)) / near;
        float along = (seen - lit) * 0.70710678f;
        along = side >= 0.0f ? along : -along;
        float phi = arctangent(std::fabs(side), std::fabs(along));
        phi = along < 0.0f ? PI - phi : phi;
        const float x = std::sqrt(theta_h) * per_h, y = theta_d * per_d;
        const float z = sin_h > 1e-6f ? phi * per_phi : 0.0f;
        const int i = std::min(static_cast<int>(x), last_h);
        const int j = std::min(static_cast<int>(y), last_d);
        int k = static_cast<int>(z);
        float fx = x - i;
        const float fy = y - j, fz = z - k;
        int after = k + 1;
        k = k < n_phi ? k : 0;
        after = after < n_phi ? after : 0;
        const int first = (i * nd + j) * n_phi;
        c.corner[0][q] = (first + k) * WIDTH;
        c.corner[1][q] = (first + after) * WIDTH;
        const float cosine = std::min(lit, seen) > 0.0f ? lit : 0.0f;
        const float gx = (1.0f - fx) * cosine;
        fx *= cosine;
        const float gy = 1.0f - fy, gz = 1.0f - fz;
        c.share[0][q] = gx * gy * gz;
        c.share[1][q] = gx * gy * fz;
        c.share[2][q] = gx * fy * gz;
        c.share[3][q] = gx * fy * fz;
        c.share[4][q] = fx * gy * gz;
        c.share[5][q] = fx * gy * fz;
        c.share[6][q] = fx * fy * gz;
        c.share[7][q] = fx * fy * fz;
    }
}

// rows[q] = weighted sum of the eight corners of the cell of q
void blend(const float* table, int count, int along, int across, const Cells& c, float* rows) {
    for (int q = 0; q < count; ++q) {
        const float* a = table + c.corner[0][q];
        const float* b = table + c.corner[1][q];
        float* row = rows + q * WIDTH;
        for (int m = 0; m < WIDTH; ++m)
            row[m] = c.share[0][q] * a[m] + c.share[1][q] * b[m] +
                     c.share[2][q] * a[along + m] + c.share[3][q] * b[along + m] +
                     c.share[4][q] * a[across + m] + c.share[5][q] * b[across + m] +
                     c.share[6][q] * a[across + along + m] +
                     c.share[7][q] * b[across + along + m];
    }
}

// G = M' diag(a) M and b = M' t, summed in single precision over some rows, then in double
void products(const float* rows, int n, const float* a, const float* t, double* G, double* b) {
    std::memset(G, 0, WIDTH * WIDTH * sizeof(double));
    std::memset(b, 0, WIDTH * sizeof(double));
    for (int begin = 0; begin < n; begin += ROWS_PER_SUM) {
        const int end = std::min(begin + ROWS_PER_SUM, n);
        float g[WIDTH][WIDTH] = {};
        float sum[WIDTH] = {};
        for (int i = begin; i < end; ++i) {
            const float* row = rows + i * WIDTH;
            float weighted[WIDTH];
            for (int m = 0; m < WIDTH; ++m) weighted[m] = row[m] * a[i];
            for (int k = 0; k < WIDTH; ++k)
                for (int m = 0; m < WIDTH; ++m) g[k][m] += row[k] * weighted[m];
            for (int m = 0; m < WIDTH; ++m) sum[m] += row[m] * t[i];
        }
        for (int k = 0; k < WIDTH; ++k)
            for (int m = 0; m < WIDTH; ++m) G[k * WIDTH + m] += g[k][m];
        for (int m = 0; m < WIDTH; ++m) b[m] += sum[m];
    }
}

}  // namespace

// For each surfel its rows from directions (normal (n, 3), light (n, l, 3), camera
// (n, c, 3), usable (n, l, c)), then, if `multiply`, G (n, 24, 24) and b (n, 24) with weights
// 1 and targets 1; returns the number of rows. `rows` holds those of one surfel.
extern "C" int64_t rows_and_products(const float* table, const int32_t* shape, int n, int lights,
                                     int cameras, const double* normal, const double* to_light,
                                     const double* to_camera, const uint8_t* usable,
                                     float* rows, double* G, double* b, int multiply) {
    const int along = shape[2] * WIDTH, across = shape[1] * along;
    const std::vector<float> ones(static_cast<size_t>(lights) * cameras, 1.0f);
    Cells c;
    int64_t all = 0;
    for (int s = 0; s < n; ++s) {
        const float v[3] = {static_cast<float>(normal[3 * s]), static_cast<float>(normal[3 * s + 1]),
                            static_cast<float>(normal[3 * s + 2])};
        const auto above = [&](const double* d) {
            return normal[3 * s] * d[0] + normal[3 * s + 1] * d[1] + normal[3 * s + 2] * d[2] > 0.0;
        };
        int count = 0, filled = 0;
        const auto flush = [&] {
            write_cells(v, filled, shape, c);
            blend(table, filled, along, across, c, rows + static_cast<size_t>(count) * WIDTH);
            count += filled;
            filled = 0;
        };
        for (int i = 0; i < lights; ++i) {
            const double* light = to_light + 3 * (static_cast<size_t>(s) * lights + i);
            if (!above(light)) continue;
            for (int o = 0; o < cameras; ++o) {
                const double* camera = to_camera + 3 * (static_cast<size_t>(s) * cameras + o);
                if (!usable[(static_cast<size_t>(s) * lights + i) * cameras + o] || !above(camera))
                    continue;
                for (int k = 0; k < 3; ++k) {
                    c.way[k][filled] = static_cast<float>(light[k]);
                    c.way[3 + k][filled] = static_cast<float>(camera[k]);
                }
                if (++filled == CHUNK) flush();
            }
        }
        flush();
        if (multiply)
            products(rows, count, ones.data(), ones.data(),
                     G + static_cast<size_t>(s) * WIDTH * WIDTH, b + static_cast<size_t>(s) * WIDTH);
        all += count;
    }
    return all;
}
