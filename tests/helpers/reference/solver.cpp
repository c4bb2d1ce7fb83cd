// An independent event-exact solver for one structure in frictional contact with a belt.
//
//   M q'' + C q' + K q = f(t) d + T e_t + N e_n
//
// sticking (0): gap closed, v_t = belt speed, |T| <= mu_s N
// sliding (1):  gap closed, T = sigma mu(|v_rel|) N, sigma = -sign(v_rel), v_rel = v_t - belt speed
// detachment (2): T = N = 0 until the gap closes
//
// The state is z = (x, v): x is the displacement from the sliding equilibrium under the load after the pulse, so that a
// motion much smaller than that equilibrium keeps its digits. With constant friction every mode is z' = A z + b, and a
// step is its Taylor series; guards are the step's own polynomials. With exponentially falling friction the series of
// sliding comes from the recurrences of the product and of the exponential.
//
// Roots: a guard g > 0 is followed from the left with the bound g(u + s) >= g + g' s - B s^2 / 2, where B bounds |g''|
// up to the end of the step. No zero can be stepped over, a dip inside a step included. A guard that starts from zero (after
// lift-off the gap, its rate and its acceleration are zero) is divided by its leading power of u first.
#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstring>
#include <limits>
#include <memory>
#include <thread>
#include <vector>

typedef double v8 __attribute__((vector_size(64)));
typedef long double real;
static const double EPS = std::numeric_limits<double>::epsilon();
static const int NMAX = 8, ORD = 24, OB = ORD / 8;

enum Mode { STICK = 0, SLIDE = 1, DETACH = 2 };
enum Fate { SLIDES = 0, SUSTAINED = 1, UNBOUNDED = 2, GAVE_UP = 3 };
enum Trouble { NONE = 0, NO_EQUILIBRIUM = 1, PAINLEVE = 2, ZENO = 3, BELOW_THE_BELT = 4, STEPS = 5, NO_ROOT = 6 };

extern "C" {
struct SceneData {
    double M[64], C[64], K[64], d[8];
    double mu_d, mu_s, decay;  // mu = mu_d + (mu_s - mu_d) exp(-decay w) where falling; else mu_d, and mu_s for sticking
    double belt, force, p, start, duration, restitution;
    double y0[16];  // see has_y0
    int n, it, iz, falling, impact_law, has_y0;  // has_y0: 0 equilibrium, 1 (q, v), 2 (q - equilibrium, v)
};
struct FateData {
    double t_end, last_event, amplitude[10], forward[10], windows_from, window, size;
    double section[17];  // time, displacement from the equilibrium and velocity at the last crossing
    long long events, late_events, crossings, steps;
    int fate, trouble, mode, direction;
};
struct Modal {  // of linearised sliding: c = W (z of the contact coordinates), |N deviation| and |v_t| by sum reach |c|
    double re[196], im[196], reach[2][14];
    double growth[14];       // real parts of the eigenvalues, 1/s
    double rate, quadratic;  // slowest decay (1/s); d|c|/dt <= -rate |c| + quadratic |c|^2
    int modes, usable;       // whether W and growth are known, and whether all modes decay
};
struct Record {
    // in
    const double* times;
    long long n_times, max_events, max_crossings;
    // out
    double *q, *v, *forces;  // (n_times, n), (n_times, n), (n_times, 2): N, T
    int* mode;               // (n_times)
    double *event_t, *crossing;  // (max_events), (max_crossings, 1 + 2n)
    int *event_mode, *crossing_mode;  // (max_events, 2), (max_crossings)
    long long n_events, n_crossings, n_sampled;
};
}

static bool solve(int n, std::vector<real> a, std::vector<real>& x, int cols) {
    // Gauss with pivots; x is (n, cols)
    for (int k = 0; k < n; k++) {
        int p = k;
        for (int i = k + 1; i < n; i++)
            if (fabsl(a[i * n + k]) > fabsl(a[p * n + k])) p = i;
        if (a[p * n + k] == 0) return false;
        for (int j = 0; j < n; j++) std::swap(a[p * n + j], a[k * n + j]);
        for (int j = 0; j < cols; j++) std::swap(x[p * cols + j], x[k * cols + j]);
        for (int i = 0; i < n; i++) {
            if (i == k) continue;
            real m = a[i * n + k] / a[k * n + k];
            if (m == 0) continue;
            for (int j = k; j < n; j++) a[i * n + j] -= m * a[k * n + j];
            for (int j = 0; j < cols; j++) x[i * cols + j] -= m * x[k * cols + j];
        }
    }
    for (int k = 0; k < n; k++)
        for (int j = 0; j < cols; j++) x[k * cols + j] /= a[k * n + k];
    return true;
}

static std::vector<real> inverse(int n, const std::vector<real>& a, bool& fine) {
    std::vector<real> x(n * n, 0);
    for (int i = 0; i < n; i++) x[i * n + i] = 1;
    fine = solve(n, a, x, n);
    return x;
}

// ---------------------------------------------------------------------------------------------------------- mechanics

struct Mechanics {
    const SceneData& s;
    int n, it, iz, nc = 0, ns = 0, c[NMAX], st[NMAX];  // coordinates free in contact, and when stuck
    std::vector<real> Minv, Mc, Ms;
    real row[NMAX], pull[NMAX];  // M_nc M_cc^-1 and M_cc^-1 e_t, on contact coordinates
    real kappa = 0, q_eq[NMAX] = {}, N0 = 0, T0 = 0, f0 = 0, omega = 1;
    double sigma0 = 1, length = 1;
    int trouble = NONE;
    bool has_equilibrium = false;

    double mu(double w) const { return s.falling ? s.mu_d + (s.mu_s - s.mu_d) * std::exp(-s.decay * w) : s.mu_d; }

    explicit Mechanics(const SceneData& scene) : s(scene), n(scene.n), it(scene.it), iz(scene.iz) {
        for (int i = 0; i < n; i++) {
            if (i != iz) c[nc++] = i;
            if (i != iz && i != it) st[ns++] = i;
        }
        bool fine;
        std::vector<real> m(n * n), mc(nc * nc), ms(ns * ns);
        for (int i = 0; i < n * n; i++) m[i] = s.M[i];
        for (int i = 0; i < nc; i++)
            for (int j = 0; j < nc; j++) mc[i * nc + j] = s.M[c[i] * n + c[j]];
        for (int i = 0; i < ns; i++)
            for (int j = 0; j < ns; j++) ms[i * ns + j] = s.M[st[i] * n + st[j]];
        Minv = inverse(n, m, fine), Mc = inverse(nc, mc, fine), Ms = inverse(ns, ms, fine);
        for (int i = 0; i < nc; i++) {
            row[i] = 0;
            for (int j = 0; j < nc; j++) {
                row[i] += s.M[iz * n + c[j]] * Mc[j * nc + i];
                if (c[j] == it) pull[i] = Mc[i * nc + j];
            }
        }
        for (int i = 0; i < nc; i++) kappa += s.M[iz * n + c[i]] * pull[i];
        // the largest frequency is below this norm of M^-1 K, and so is its square root below
        real largest = 0;
        for (int i = 0; i < n; i++) {
            real sum = 0;
            for (int j = 0; j < n; j++) {
                real k = 0;
                for (int l = 0; l < n; l++) k += Minv[i * n + l] * s.K[l * n + j];
                sum += fabsl(k);
            }
            largest = std::max(largest, sum);
        }
        omega = largest > 0 ? sqrtl(largest) : 1;
        sigma0 = s.belt < 0 ? -1 : 1;
        if (s.belt != 0) equilibrium();
        double f = s.force * std::max(1.0, std::fabs(s.p)), size = std::fabs(s.belt) / (double)omega;
        for (int i = 0; i < n; i++) {
            real a = 0;
            for (int j = 0; j < n; j++) a += Minv[i * n + j] * f * s.d[j];
            size = std::max({size, (double)(fabsl(a) / (omega * omega)), (double)fabsl(q_eq[i])});
        }
        length = size > 0 ? size : 1;
    }

    void equilibrium() {
        double m = sigma0 * mu(std::fabs(s.belt));
        std::vector<real> a(nc * nc), x(nc);
        for (int i = 0; i < nc; i++) {
            real e = c[i] == it ? m : 0;
            for (int j = 0; j < nc; j++) a[i * nc + j] = s.K[c[i] * n + c[j]] - e * s.K[iz * n + c[j]];
            x[i] = (real)s.force * (s.d[c[i]] - e * s.d[iz]);
        }
        if (!solve(nc, a, x, 1)) return;
        real normal = -(real)s.force * s.d[iz];
        for (int i = 0; i < nc; i++) normal += s.K[iz * n + c[i]] * x[i];
        if (!(normal > 0) || !std::isfinite((double)normal)) return;
        for (int i = 0; i < nc; i++) q_eq[c[i]] = x[i];
        N0 = normal, T0 = m * normal, f0 = s.force, has_equilibrium = true;
    }

    // acceleration, N and T, in deviations; one = 1 takes the constant forces in, 0 leaves the linear part
    void forces(int mode, real sigma_mu, const real* x, const real* v, real one, double f, real* a, real& N, real& T) const {
        real r[NMAX] = {};
        for (int i = 0; i < n; i++) {
            r[i] = one * ((f - f0) * s.d[i] - (i == it ? T0 : 0) - (i == iz ? N0 : 0));
            for (int j = 0; j < n; j++) r[i] -= s.C[i * n + j] * v[j] + s.K[i * n + j] * x[j];
            a[i] = 0;
        }
        N = T = 0;
        if (mode == SLIDE) {
            for (int i = 0; i < nc; i++) N += row[i] * r[c[i]];
            N = (N - r[iz]) / (1 - sigma_mu * kappa);
            T = sigma_mu * N;
            for (int i = 0; i < nc; i++) {
                for (int j = 0; j < nc; j++) a[c[i]] += Mc[i * nc + j] * r[c[j]];
                a[c[i]] += pull[i] * T;
            }
        } else if (mode == STICK) {
            for (int i = 0; i < ns; i++)
                for (int j = 0; j < ns; j++) a[st[i]] += Ms[i * ns + j] * r[st[j]];
            N = -r[iz], T = -r[it];
            for (int j = 0; j < n; j++) N += s.M[iz * n + j] * a[j], T += s.M[it * n + j] * a[j];
        } else {
            for (int i = 0; i < n; i++)
                for (int j = 0; j < n; j++) a[i] += Minv[i * n + j] * r[j];
        }
    }
};

// ------------------------------------------------------------------------------------------------------------- tables

template <int RB>
struct Table {  // of one mode, direction and load
    static const int NC = RB * 8 + 1;
    double h = 1;
    int cols = 0, col[NC], guards = 0;
    v8 P[NC][RB], T[ORD][NC][RB], G[3][NC][OB], A[NC][RB];
    double N[NC], F[NC];  // rows of the contact forces; in sliding with falling friction N is (1 - sigma mu kappa) N

    Table(const Mechanics& m, int mode, double sigma, double f) {
        const int n = m.n, D = 2 * n + 1;
        const SceneData& s = m.s;
        bool recurrence = mode == SLIDE && s.falling;
        real sigma_mu = recurrence ? 0 : mode == SLIDE ? sigma * s.mu_d : 0;
        std::vector<real> A(D * D, 0), rows(3 * D, 0), normal(D, 0), friction(D, 0);
        for (int j = 0; j < D; j++) {
            real x[NMAX] = {}, v[NMAX] = {}, a[NMAX], N, T;
            if (j < n) x[j] = 1;
            else if (j < 2 * n) v[j - n] = 1;
            if (mode != DETACH && (j == m.iz || j == n + m.iz)) continue;
            m.forces(mode, sigma_mu, x, v, j == 2 * n, f, a, N, T);
            if (recurrence && j == 2 * n)  // the friction force is a term of its own there, as its difference from T0
                for (int i = 0; i < m.nc; i++) a[m.c[i]] += m.pull[i] * m.T0;
            for (int i = 0; i < n; i++) A[(n + i) * D + j] = a[i], A[i * D + j] = v[i];
            normal[j] = N, friction[j] = T;
        }
        if (mode == SLIDE && m.has_equilibrium && f == (double)m.f0 && (recurrence || sigma == m.sigma0)) {
            for (int i = 0; i < 2 * n; i++) A[i * D + 2 * n] = 0;  // zero but for rounding
            if (!recurrence) normal[2 * n] = m.N0, friction[2 * n] = m.T0;
        }
        if (mode == STICK)
            for (int i = 0; i < n; i++)  // the belt carries the contact point: exactly
                if (i == m.it) A[(n + i) * D + 2 * n] = 0;
        for (int j = 0; j < D; j++) {
            this->N[j] = normal[j], F[j] = friction[j];
            if (mode == SLIDE) rows[j] = normal[j];
            if (mode == STICK) rows[j] = s.mu_s * normal[j] - friction[j], rows[D + j] = s.mu_s * normal[j] + friction[j];
        }
        if (mode == SLIDE) rows[D + n + m.it] = -sigma, rows[D + 2 * n] = sigma * s.belt;
        if (mode == DETACH) rows[m.iz] = 1;
        guards = mode == DETACH ? 1 : 2;
        rows[2 * D + n + m.it] = 1;
        for (int j = 0; j < D; j++)
            if (mode == DETACH || (j != m.iz && j != n + m.iz)) col[cols++] = j;
        // the step: as long as the next term of the series is nothing
        h = 4.0 / (double)m.omega;
        std::vector<real> term(D * D), next(D * D);
        std::vector<std::vector<real>> all;
        for (int halvings = 0;; halvings++) {
            all.clear();
            std::fill(term.begin(), term.end(), 0);
            for (int i = 0; i < D; i++) term[i * D + i] = 1;
            for (int k = 0;; k++) {
                all.push_back(term);
                if (k == ORD) break;
                for (int i = 0; i < D; i++)
                    for (int j = 0; j < D; j++) {
                        real sum = 0;
                        for (int l = 0; l < 2 * n; l++) sum += A[i * D + l] * term[l * D + j];
                        if (k == 0) sum = A[i * D + j];
                        next[i * D + j] = sum * (real)h / (k + 1);
                    }
                term = next;
            }
            real worst = 0;  // velocities count over omega, the constant column over the length
            for (int i = 0; i < 2 * n; i++)
                for (int j = 0; j < D; j++) {
                    real e = fabsl(all[ORD][i * D + j]);
                    if (i >= n) e /= m.omega;
                    if (j >= n && j < 2 * n) e *= m.omega;
                    if (j == 2 * n) e /= m.length;
                    worst = std::max(worst, e);
                }
            if (worst < 1e-17 || halvings > 60) break;
            h *= 0.8;
        }
        memset(P, 0, sizeof P), memset(T, 0, sizeof T), memset(G, 0, sizeof G), memset(this->A, 0, sizeof this->A);
        for (int j = 0; j < D; j++) {
            for (int i = 0; i < 2 * n; i++) {
                real sum = 0;
                for (int k = ORD; k >= 0; k--) sum += all[k][i * D + j];
                P[j][i / 8][i % 8] = sum;
                for (int k = 0; k < ORD; k++) T[k][j][i / 8][i % 8] = all[k][i * D + j];
                this->A[j][i / 8][i % 8] = A[i * D + j];
            }
            for (int g = 0; g < 3; g++)
                for (int k = 0; k < ORD; k++) {
                    real sum = k == 0 && j == 2 * n ? rows[g * D + 2 * n] : 0;
                    for (int i = 0; i < 2 * n; i++) sum += rows[g * D + i] * all[k][i * D + j];
                    G[g][j][k / 8][k % 8] = sum;
                }
        }
    }
};

// ---------------------------------------------------------------------------------------------------------- polynomials

struct alignas(64) Poly {
    union {
        double c[ORD];
        v8 b[OB];
    };
    Poly() {}
};

static inline double value(const double* c, int terms, double u) {
    double r = c[terms - 1];
    for (int k = terms - 2; k >= 0; k--) r = r * u + c[k];
    return r;
}

static inline void value_and_slope(const double* c, int terms, double u, double& r, double& s) {
    r = c[terms - 1], s = 0;
    for (int k = terms - 2; k >= 0; k--) s = s * u + r, r = r * u + c[k];
}

static inline double sum_of(v8 a) { return ((a[0] + a[1]) + (a[2] + a[3])) + ((a[4] + a[5]) + (a[6] + a[7])); }
static inline v8 absolute(v8 a) { return a < 0 ? -a : a; }

struct Curvature {
    v8 w[OB];
    Curvature() {
        for (int k = 0; k < ORD; k++) w[k / 8][k % 8] = k * (k - 1.0);
    }
};
static const Curvature CURVATURE;

// the first zero of the polynomial from above in (0, end], or 2
static inline double first_zero(const double* c, int terms, double bound, double end) {
    double g = c[0], slope = c[1], u = 0;
    if (g <= 0) return 0;
    for (int i = 0; i < 1000; i++) {
        if (g + slope * (end - u) - 0.5 * bound * (end - u) * (end - u) > 0) return 2;
        double root = std::sqrt(slope * slope + 2 * bound * g);
        double s = slope >= 0 ? (slope + root) / bound : 2 * g / (root - slope);
        u += s;
        if (u > end) return 2;
        value_and_slope(c, terms, u, g, slope);
        if (g <= 0 || s < 1e-15) return u;
    }
    return NAN;
}

// a zero of the polynomial (or of its slope) between two points where it has different signs
static double between(const double* c, int terms, double a, double b) {
    double fa = value(c, terms, a), fb = value(c, terms, b), x = 0.5 * (a + b);
    if (fa == 0) return a;
    if (fb == 0) return b;
    for (int i = 0; i < 100; i++) {
        double f, s;
        value_and_slope(c, terms, x, f, s);
        if (f == 0) return x;
        if ((f > 0) == (fa > 0)) a = x;
        else b = x;
        double next = s != 0 ? x - f / s : a;
        if (!(next > a && next < b)) next = 0.5 * (a + b);
        if (std::fabs(next - x) <= 2e-16 || b - a <= 2e-16) return next;
        x = next;
    }
    return x;
}

// ------------------------------------------------------------------------------------------------------------- solver

template <int RB>
struct Solver {
    typedef Table<RB> Tab;
    Mechanics m;
    const SceneData& s;
    int n, it, iz;
    std::unique_ptr<Tab> tables[2][4];
    alignas(64) double z[RB * 8 + 8];
    double t = 0;
    int mode = SLIDE, load = 0;
    double sigma = 1;
    double largest_impact = 0;
    int trouble = NONE;
    double Mi_t[NMAX], Mi_n[NMAX];

    explicit Solver(const SceneData& scene) : m(scene), s(scene), n(scene.n), it(scene.it), iz(scene.iz) {
        memset(z, 0, sizeof z);
        z[2 * n] = 1;
        for (int i = 0; i < n; i++) Mi_t[i] = m.Minv[i * n + it], Mi_n[i] = m.Minv[i * n + iz];
        largest_static = std::max(s.mu_s, s.mu_d);
        if (largest_static * std::fabs((double)m.kappa) >= 1) trouble = PAINLEVE;
    }
    double largest_static;

    double force(int which) const { return which ? s.p * s.force : s.force; }

    Tab& table(int mode, double sigma) {
        int k = mode == STICK ? 0 : mode == DETACH ? 3 : sigma > 0 ? 1 : 2;
        auto& slot = tables[load][k];
        if (!slot) slot.reset(new Tab(m, mode, sigma, force(load)));
        return *slot;
    }

    double dot(const double* row, double* noise = nullptr) const {
        double sum = 0, size = 0;
        for (int j = 0; j <= 2 * n; j++) {
            double a = row[j] * z[j];
            sum += a, size += std::fabs(a);
        }
        if (noise) *noise = size;
        return sum;
    }

    void rate(Tab& tb, const double* y, double one, double* out) const {
        for (int i = 0; i < 2 * n; i++) {
            double sum = one * tb.A[2 * n][i / 8][i % 8];
            for (int j = 0; j < 2 * n; j++) sum += tb.A[j][i / 8][i % 8] * y[j];
            out[i] = sum;
        }
    }

    static constexpr double EDGE = 4096;  // roundings within which a force counts as zero

    // the status that the forces demand
    void choose() {
        if (z[iz] > 0 || z[n + iz] > 0) {
            mode = DETACH;
            return;
        }
        z[iz] = z[n + iz] = 0;
        double slip = z[n + it] - s.belt, size_n, size_t;
        if (slip == 0) {
            Tab& tb = table(STICK, 1);
            double N = dot(tb.N, &size_n), T = dot(tb.F, &size_t), margin = s.mu_s * N - std::fabs(T);
            double noise = EDGE * EPS * (s.mu_s * size_n + size_t);
            if (std::fabs(margin) <= noise) {
                double y[16], Nr = 0, Tr = 0;
                rate(tb, z, 1, y);
                for (int j = 0; j < 2 * n; j++) Nr += tb.N[j] * y[j], Tr += tb.F[j] * y[j];
                margin = s.mu_s * Nr - (T > 0 ? Tr : -Tr);
            }
            if (margin >= 0 && N > -EDGE * EPS * size_n) {
                mode = STICK;
                return;
            }
            sigma = T > 0 ? 1 : -1;
        } else {
            sigma = slip > 0 ? -1 : 1;
        }
        Tab& tb = table(SLIDE, sigma);
        double N = dot(tb.N, &size_n);
        if (std::fabs(N) <= EDGE * EPS * size_n) {  // the jerk of the free gap decides
            Tab& free = table(DETACH, 1);
            double y[16], w[16];
            rate(free, z, 1, y);
            y[n + iz] = 0;
            rate(free, y, 0, w);
            N = -w[n + iz];
        }
        mode = N >= 0 ? SLIDE : DETACH;
    }

    void impact() {
        double slip = z[n + it] - s.belt, speed = -z[n + iz], e = s.restitution;
        largest_impact = std::max(largest_impact, speed);
        if (s.impact_law == 0) {
            double wtt = Mi_t[it], wtn = Mi_n[it], wnn = Mi_n[iz], det = wtt * wnn - wtn * wtn;
            double u = -slip, w = (1 + e) * speed;
            double Pt = (wnn * u - wtn * w) / det, Pn = (wtt * w - wtn * u) / det;
            double mu = m.mu(std::fabs(slip));
            bool sticks = std::fabs(Pt) <= mu * Pn;
            if (!sticks) {
                double dir = Pt > 0 ? 1 : -1;
                double compliance = wnn + dir * mu * wtn;
                if (compliance <= 0) trouble = PAINLEVE;
                Pn = w / compliance, Pt = dir * mu * Pn;
            }
            for (int i = 0; i < n; i++) z[n + i] += Mi_t[i] * Pt + Mi_n[i] * Pn;
            if (sticks) z[n + it] = s.belt;
        } else if (s.impact_law == 1) {
            double Pn = (1 + e) * speed / Mi_n[iz];
            for (int i = 0; i < n; i++) z[n + i] += Mi_n[i] * Pn;
        }
        double rebound = e * speed;
        z[n + iz] = rebound > 1e-7 * largest_impact ? rebound : 0;
    }

    bool begin() {
        if (trouble) return false;
        if (s.has_y0 == 0) {
            if (!m.has_equilibrium) return trouble = NO_EQUILIBRIUM, false;
        } else {
            for (int i = 0; i < n; i++) {
                z[i] = s.has_y0 == 1 ? (double)((real)s.y0[i] - m.q_eq[i]) : s.y0[i];
                z[n + i] = s.y0[n + i];
            }
            if (z[iz] < 0 || (z[iz] == 0 && z[n + iz] < 0)) return trouble = BELOW_THE_BELT, false;
        }
        next_jump = jump(0);
        choose();
        return true;
    }

    double next_jump = 0, infinity = std::numeric_limits<double>::infinity();
    // sets the load at this time and returns when it changes next
    double jump(double at) {
        bool kick = s.p != 1 && s.duration > 0;
        double stop = s.start + s.duration;
        load = kick && at >= s.start && at < stop;
        return !kick || at >= stop ? infinity : at < s.start ? s.start : stop;
    }

    // -------------------------------------------------------------------------------------------- one step

    Poly guard[3];
    v8 series[ORD][RB];
    bool have_series = false;
    double valid = 1;

    inline void linear(const Tab& tb) {
        for (int g = 0; g < 3; g++) {
            if (g == 1 && tb.guards == 1) continue;
            for (int b = 0; b < OB; b++) {
                v8 sum = {};
                for (int j = 0; j < tb.cols; j++) sum += tb.G[g][tb.col[j]][b] * z[tb.col[j]];
                guard[g].b[b] = sum;
            }
        }
        have_series = false, valid = 1;
    }

    inline void need_series(const Tab& tb) {
        if (have_series) return;
        for (int k = 0; k < ORD; k++)
            for (int b = 0; b < RB; b++) {
                v8 sum = {};
                for (int j = 0; j < tb.cols; j++) sum += tb.T[k][tb.col[j]][b] * z[tb.col[j]];
                series[k][b] = sum;
            }
        have_series = true;
    }

    // sliding with falling friction: the series of z, N and the slip speed
    void recurrence(const Tab& tb) {
        const double h = tb.h, kap = (double)m.kappa, delta = s.mu_s - s.mu_d, w0 = sigma * (s.belt - z[n + it]);
        double E[ORD], mu[ORD], N[ORD], w[ORD], pull[NMAX];
        for (int i = 0; i < m.nc; i++) pull[i] = (double)m.pull[i];
        v8 now[RB], push[RB];
        for (int b = 0; b < RB; b++) push[b] = v8{}, memcpy(&now[b], z + 8 * b, 64);
        for (int i = 2 * n; i < 8 * RB; i++) now[i / 8][i % 8] = 0;
        for (int i = 0; i < m.nc; i++) push[(n + m.c[i]) / 8][(n + m.c[i]) % 8] = pull[i];
        double gain = 1;
        for (int k = 0; k < ORD; k++) {
            for (int b = 0; b < RB; b++) series[k][b] = now[b];
            double ell = 0;  // (1 - sigma mu kappa) N, without its constant
            for (int j = 0; j < tb.cols - 1; j++) ell += tb.N[tb.col[j]] * now[tb.col[j] / 8][tb.col[j] % 8];
            double T;  // coefficient of the friction force, less T0
            w[k] = k ? -sigma * now[(n + it) / 8][(n + it) % 8] : w0;
            if (k == 0) {
                E[0] = std::exp(-s.decay * w0);
                mu[0] = s.mu_d + delta * E[0];
                gain = 1 - sigma * kap * mu[0];
                bool home = m.has_equilibrium && sigma == m.sigma0 && load == 0;
                if (home) {
                    double mu_eq = m.mu(std::fabs(s.belt)), dmu = (mu_eq - s.mu_d) * std::expm1(s.decay * sigma * z[n + it]);
                    double dN = (ell + sigma * kap * dmu * (double)m.N0) / gain;
                    N[0] = (double)m.N0 + dN;
                    T = sigma * (mu_eq * dN + dmu * N[0]);
                } else {
                    N[0] = (ell + tb.N[2 * n]) / gain;
                    T = sigma * mu[0] * N[0] - (double)m.T0;
                }
            } else {
                double e = 0;
                for (int j = 1; j <= k; j++) e += j * w[j] * E[k - j];
                E[k] = -s.decay / k * e;
                mu[k] = delta * E[k];
                double mix = 0;
                for (int j = 1; j <= k; j++) mix += mu[j] * N[k - j];
                N[k] = (ell + sigma * kap * mix) / gain;
                T = sigma * (mix + mu[0] * N[k]);
            }
            v8 next[RB];
            for (int b = 0; b < RB; b++) {
                next[b] = push[b] * T;
                if (k == 0) next[b] += tb.A[2 * n][b];
            }
            for (int j = 0; j < tb.cols - 1; j++) {
                double y = now[tb.col[j] / 8][tb.col[j] % 8];
                for (int b = 0; b < RB; b++) next[b] += tb.A[tb.col[j]][b] * y;
            }
            for (int b = 0; b < RB; b++) now[b] = next[b] * (h / (k + 1));
        }
        for (int k = 0; k < ORD; k++) {
            guard[0].c[k] = N[k], guard[1].c[k] = w[k];
            guard[2].c[k] = series[k][(n + it) / 8][(n + it) % 8];
        }
        have_series = true;
        // how far the series holds: its last terms against its first
        auto size = [&](int k) {
            double r = 0;
            for (int i = 0; i < n; i++) {
                r = std::max(r, std::fabs(series[k][i / 8][i % 8]) * (double)m.omega);
                r = std::max(r, std::fabs(series[k][(n + i) / 8][(n + i) % 8]));
            }
            return r;
        };
        double big = std::max({size(0), size(1), size(2), 1e-300});
        valid = 1;
        for (int k = ORD - 3; k < ORD; k++) {
            double r = size(k) / big, wanted = 1e-17 * std::pow(10.0, 0.5 * (ORD - 1 - k));
            if (r > wanted) valid = std::min(valid, std::pow(wanted / r, 1.0 / k));
        }
    }

    inline void at(const Tab& tb, double u, double* out) {
        need_series(tb);
        v8 r[RB];
        for (int b = 0; b < RB; b++) r[b] = series[ORD - 1][b];
        for (int k = ORD - 2; k >= 0; k--)
            for (int b = 0; b < RB; b++) r[b] = r[b] * u + series[k][b];
        for (int b = 0; b < RB; b++) memcpy(out + 8 * b, &r[b], 64);
        out[2 * n] = 1;
    }

    // leading coefficients of a guard that are zero but for rounding, at the start of a phase
    int leading(const Tab& tb, int g, bool nonlinear) {
        double c[ORD], noise[ORD];
        for (int k = 0; k < 6; k++) {
            noise[k] = 0;
            for (int j = 0; j < tb.cols; j++) noise[k] += std::fabs(tb.G[g][tb.col[j]][k / 8][k % 8] * z[tb.col[j]]);
            c[k] = guard[g].c[k];
            if (nonlinear && g == 1) {  // the friction force is not in the table
                double f = largest_static * (std::fabs(guard[0].c[0]) + std::fabs((double)m.T0)) * std::fabs((double)m.pull[0]);
                for (int i = 0; i < m.nc; i++)
                    if (m.c[i] == it) f = largest_static * (std::fabs(guard[0].c[0]) + (double)m.N0) * (double)m.pull[i];
                if (k > 0) noise[k] += f * tb.h * std::pow((double)m.omega * tb.h, k - 1) / std::tgamma(k + 1.0);
            }
            if (std::fabs(c[k]) > EDGE * EPS * noise[k] || k == 5) return k;
        }
        return 0;
    }

    bool fresh = true;  // the step is the first of its phase

    // the first zero among the guards in (0, end], as (u, which); u = 2 without one
    double root(const Tab& tb, double end, bool nonlinear) {
        double best = 2;
        for (int g = 0; g < tb.guards; g++) {
            int lead = fresh ? leading(tb, g, nonlinear) : 0;
            const double* c = guard[g].c + lead;
            double bound;
            double reach = std::min(end, best);
            if (lead || end < 0.9) {
                bound = 0;
                double power = 1;
                for (int k = 2; k < ORD - lead; k++, power *= end) bound += k * (k - 1.0) * std::fabs(c[k]) * power;
            } else {
                v8 sum = {};
                for (int b = 0; b < OB; b++) sum += absolute(guard[g].b[b]) * CURVATURE.w[b];
                bound = sum_of(sum);
                if (c[0] + std::min(0.0, c[1]) - 0.5 * bound > 0) continue;
            }
            double u = first_zero(c, ORD - lead, bound, reach);
            if (!(u >= 0)) trouble = NO_ROOT;
            if (u < best) best = u;
        }
        return best;
    }

    // after the guard at u: put the state on the constraint that was met
    void snap(double u, bool nonlinear) {
        if (mode == DETACH) {
            z[iz] = 0;
            if (z[n + iz] < 0) impact();
            else z[n + iz] = 0;
        } else if (mode == SLIDE) {
            // which guard is zero: the slip speed, or the normal force
            double slip = std::fabs(value(guard[1].c, ORD, u)), N = std::fabs(value(guard[0].c, ORD, u));
            double s0 = 0, n0 = 0;
            for (int k = 0; k < ORD; k++) s0 += std::fabs(guard[1].c[k]), n0 += std::fabs(guard[0].c[k]);
            if (slip * n0 <= N * s0 || slip <= 64 * EPS * s0) z[n + it] = s.belt;
        }
    }

    // ---------------------------------------------------------------------------------------------- the run

    int amplitudes(const Modal& md, double* size) const {
        int k = 2 * m.nc;
        double zc[14];
        for (int i = 0; i < m.nc; i++) zc[i] = z[m.c[i]], zc[m.nc + i] = z[n + m.c[i]];
        for (int i = 0; i < k; i++) {
            double a = 0, b = 0;
            for (int j = 0; j < k; j++) a += md.re[i * k + j] * zc[j], b += md.im[i * k + j] * zc[j];
            size[i] = std::sqrt(a * a + b * b);
        }
        return k;
    }

    bool at_home() const { return mode == SLIDE && sigma == m.sigma0 && load == 0 && next_jump == infinity; }

    // the linear future of forward sliding keeps N > 0 and the direction of slip for ever
    bool settled(const Modal& md) const {
        if (!md.usable || !at_home()) return false;
        double size[14], sum = 0, a = 0, b = 0;
        int k = amplitudes(md, size);
        for (int i = 0; i < k; i++) sum += size[i], a += md.reach[0][i] * size[i], b += md.reach[1][i] * size[i];
        if (s.falling) {
            double r0 = 0, r1 = 0;
            for (int i = 0; i < k; i++) r0 = std::max(r0, md.reach[0][i]), r1 = std::max(r1, md.reach[1][i]);
            return md.quadratic * sum < 0.9 * md.rate && r0 * sum < 0.99 && r1 * sum < 0.5;
        }
        return a < 1 - 1e-9 && b < 1 - 1e-9;
    }

    // Many steps of forward sliding at once, where the same bound shows that no event can come in that time.
    std::vector<std::vector<real>> powers;  // of the step's matrix, each the square of the one before
    bool leap(const Modal& md, double until) {
        if (!md.modes || s.falling || !at_home()) return false;
        Tab& tb = table(SLIDE, sigma);
        double size[14];
        int k = amplitudes(md, size), D = 2 * n;
        for (int e = 14; e >= 5; e--) {
            double time = tb.h * (1 << e), a = 0, b = 0;
            if (t + time > until) continue;
            for (int i = 0; i < k; i++) {
                double far = size[i] * std::max(1.0, std::exp(md.growth[i] * time));
                a += md.reach[0][i] * far, b += md.reach[1][i] * far;
            }
            if (!(a < 1 - 1e-6 && b < 1 - 1e-6)) continue;
            if (powers.empty()) {
                powers.emplace_back(D * D);
                for (int j = 0; j < D; j++)
                    for (int i = 0; i < D; i++) powers[0][i * D + j] = tb.P[j][i / 8][i % 8];
            }
            while ((int)powers.size() <= e) {
                const auto& P = powers.back();
                std::vector<real> Q(D * D, 0);
                for (int i = 0; i < D; i++)
                    for (int l = 0; l < D; l++)
                        for (int j = 0; j < D; j++) Q[i * D + j] += P[i * D + l] * P[l * D + j];
                powers.push_back(Q);
            }
            real to[16] = {};
            for (int i = 0; i < D; i++)
                for (int j = 0; j < D; j++) to[i] += powers[e][i * D + j] * z[j];
            for (int i = 0; i < D; i++) z[i] = to[i];
            t += time;
            return true;
        }
        return false;
    }

    // t_max: where the run ends at the latest; patience: how far it goes on while no event comes
    void run(double t_max, double more, const Modal* md, FateData* out, Record* rec) {
        bool measuring = out != nullptr;
        long long events = 0, crossings = 0, steps = 0, quiet = 0, sampled = 0;
        double window = t_max / 10, window_end = window, peak = 0, top = -infinity, last_event = NAN;
        double amplitude[10] = {}, forward[10] = {};
        long long in_window = 0, late[10] = {}, windows = 0, wanted = 10;
        double recent[512];
        int at_recent = 0, zero_steps = 0;
        int fate = SUSTAINED;
        std::fill(recent, recent + 512, -infinity);
        if (!begin()) {
            if (out) out->fate = GAVE_UP, out->trouble = trouble;
            return;
        }
        fresh = true;
        double state[RB * 8 + 8], section[17] = {NAN};
        while (true) {
            if (rec && t >= t_max) break;
            if (++steps > 4000000000LL) {
                trouble = STEPS;
                break;
            }
            bool nonlinear = mode == SLIDE && s.falling;
            Tab& tb = table(mode, sigma);
            if (nonlinear) recurrence(tb);
            else linear(tb);
            double horizon = std::min(next_jump, rec ? t_max : infinity), end = std::min(1.0, valid);
            bool at_jump = false;
            if ((horizon - t) <= end * tb.h) end = (horizon - t) / tb.h, at_jump = true;
            double u = root(tb, end, nonlinear);
            if (trouble) break;
            bool event = u <= end;
            if (event) at_jump = false;
            else u = end;
            // the next state
            if (u == 1 && !nonlinear) {
                v8 r[RB];
                for (int b = 0; b < RB; b++) {
                    r[b] = v8{};
                    for (int j = 0; j < tb.cols; j++) r[b] += tb.P[tb.col[j]][b] * z[tb.col[j]];
                }
                for (int b = 0; b < RB; b++) memcpy(state + 8 * b, &r[b], 64);
            } else {
                at(tb, u, state);
            }
            double before = z[n + it], after = state[n + it];
            const double* c = guard[2].c;
            if (measuring) {
                peak = std::max({peak, std::fabs(before), std::fabs(after)});
                top = std::max({top, before, after});
                v8 sum = {};
                for (int b = 0; b < OB; b++) sum += absolute(guard[2].b[b]);
                if (sum_of(sum) > std::min(peak, std::fabs(top))) {
                    double d[ORD - 1];
                    for (int k = 1; k < ORD; k++) d[k - 1] = k * c[k];
                    if (d[0] * value(d, ORD - 1, u) < 0) {
                        double far = value(c, ORD, between(d, ORD - 1, 0, u));
                        peak = std::max(peak, std::fabs(far)), top = std::max(top, far);
                    }
                }
            }
            double low = 0, high = u;
            bool rises = before < 0 && after >= 0;
            if (rec && before < 0 && after < 0 && c[1] > 0) {  // up and down again within the step
                double d[ORD - 1];
                for (int k = 1; k < ORD; k++) d[k - 1] = k * c[k];
                if (value(d, ORD - 1, u) < 0) {
                    double top = between(d, ORD - 1, 0, u);
                    if (value(c, ORD, top) > 0) rises = true, high = top;
                }
            }
            if (rises) {
                double x = between(c, ORD, low, high), y[RB * 8 + 8];
                if (rec ? rec->n_crossings < rec->max_crossings : windows >= wanted - 3) {
                    at(tb, x, y);
                    y[n + it] = 0;
                    if (rec) {
                        double* to = rec->crossing + rec->n_crossings * (2 * n + 1);
                        to[0] = t + x * tb.h;
                        for (int i = 0; i < 2 * n; i++) to[1 + i] = y[i];
                        rec->crossing_mode[rec->n_crossings++] = mode;
                    } else {
                        section[0] = t + x * tb.h;
                        for (int i = 0; i < 2 * n; i++) section[1 + i] = y[i];
                    }
                }
                crossings++;
            }
            double until = at_jump ? horizon : t + u * tb.h;
            if (rec) {
                while (sampled < rec->n_times &&
                       (rec->times[sampled] < until || (at_jump && rec->times[sampled] <= until && until >= t_max))) {
                    double y[RB * 8 + 8];
                    at(tb, std::max(0.0, (rec->times[sampled] - t) / tb.h), y);
                    for (int i = 0; i < n; i++) {
                        rec->q[sampled * n + i] = (double)(m.q_eq[i] + (real)y[i]);
                        rec->v[sampled * n + i] = y[n + i];
                    }
                    double N = 0, T = 0;
                    if (mode != DETACH)
                        for (int j = 0; j <= 2 * n; j++) N += tb.N[j] * y[j], T += tb.F[j] * y[j];
                    if (nonlinear) {
                        double mu = m.mu(sigma * (s.belt - y[n + it]));
                        N /= 1 - sigma * mu * (double)m.kappa, T = sigma * mu * N;
                    }
                    rec->forces[2 * sampled] = N, rec->forces[2 * sampled + 1] = T;
                    rec->mode[sampled++] = mode;
                }
            }
            for (int i = 0; i < 2 * n; i++) z[i] = state[i];
            if (mode == STICK) z[n + it] = s.belt;
            t = until;
            fresh = false;
            quiet++;
            if (event || (at_jump && horizon == next_jump)) {
                int old = mode;
                double old_sigma = sigma;
                bool landed = false;
                if (event) snap(u, nonlinear), landed = old == DETACH;
                else next_jump = jump(t);
                if (event || old != DETACH) choose();
                if (trouble) break;
                fresh = true;
                if (mode != old || (mode == SLIDE && sigma != old_sigma) || landed) {
                    if (rec && rec->n_events < rec->max_events) {
                        rec->event_t[rec->n_events] = t;
                        rec->event_mode[2 * rec->n_events] = old;
                        rec->event_mode[2 * rec->n_events++ + 1] = mode;
                    }
                    events++, in_window++;
                    last_event = t, quiet = 0;
                }
                if (event) {
                    zero_steps = u == 0 ? zero_steps + 1 : 0;
                    if (zero_steps > 20 || (t - recent[at_recent]) * (double)m.omega < 1e-2) {
                        trouble = ZENO;
                        break;
                    }
                    recent[at_recent] = t, at_recent = (at_recent + 1) % 512;
                }
            }
            if (rec) continue;
            if (md && quiet >= 4 && quiet % 4 == 0 && settled(*md)) {
                fate = SLIDES;
                break;
            }
            if (md && quiet >= 32 && quiet % 32 == 0) leap(*md, window_end);
            if (t >= window_end) {
                double size = 0;
                for (int i = 0; i < n; i++)
                    size = std::max({size, std::fabs(z[i]), std::fabs(z[n + i]) / (double)m.omega});
                if (!(size < 1e6 * m.length)) {
                    fate = UNBOUNDED;
                    break;
                }
                for (int k = 0; k < 9; k++) amplitude[k] = amplitude[k + 1], forward[k] = forward[k + 1], late[k] = late[k + 1];
                amplitude[9] = peak, forward[9] = top, late[9] = in_window;
                peak = 0, top = -infinity, in_window = 0;
                window_end = (++windows + 1) * window;
                if (windows < wanted) continue;
                // Sliding without an event for the whole last window: neither settled nor sustained yet.
                bool constant = amplitude[9] == 0 || (s.falling && std::fabs(amplitude[9] / amplitude[8] - 1) < 1e-9);
                bool waits = late[9] == 0 && mode == SLIDE && !constant;
                bool woke = wanted > 10 && late[9] > 0 && late[0] == 0;  // events after a long quiet
                if (!(waits && windows < more * 10) && !(woke && windows < more * 10 + 10)) break;
                wanted++;
            }
        }
        if (rec) {
            rec->n_sampled = sampled;
        }
        if (out) {
            if (trouble) fate = GAVE_UP;
            out->fate = fate, out->trouble = trouble, out->mode = mode, out->direction = (int)sigma;
            out->t_end = t, out->last_event = last_event, out->events = events, out->late_events = late[9];
            out->crossings = crossings, out->steps = steps, out->window = window, out->windows_from = (windows - 10) * window;
            double size = 0;
            for (int i = 0; i < n; i++) size = std::max({size, std::fabs(z[i]), std::fabs(z[n + i]) / (double)m.omega});
            out->size = size;
            memcpy(out->amplitude, amplitude, sizeof amplitude);
            memcpy(out->forward, forward, sizeof forward);
            memcpy(out->section, section, sizeof section);
        }
        if (rec && out) out->trouble = trouble;
        last_trouble = trouble;
    }
    int last_trouble = 0;
};

template <int RB>
static void fate_one(const SceneData& s, double t_max, double more, const Modal* md, FateData* out) {
    Solver<RB> solver(s);
    solver.run(t_max, more, md, out, nullptr);
}

extern "C" {
long long size_of(int which) {
    return which == 0 ? sizeof(SceneData) : which == 1 ? sizeof(FateData) : which == 2 ? sizeof(Modal) : sizeof(Record);
}

void fates(const SceneData* scenes, const Modal* modal, const double* t_max, double more, FateData* out, long long count,
           int threads) {
    std::atomic<long long> next(0);
    auto work = [&]() {
        for (long long i; (i = next++) < count;) {
            memset(&out[i], 0, sizeof(FateData));
            if (scenes[i].n <= 4) fate_one<1>(scenes[i], t_max[i], more, &modal[i], &out[i]);
            else fate_one<2>(scenes[i], t_max[i], more, &modal[i], &out[i]);
        }
    };
    std::vector<std::thread> pool;
    for (int k = 1; k < threads; k++) pool.emplace_back(work);
    work();
    for (auto& th : pool) th.join();
}

int trajectory(const SceneData* scene, double t_end, Record* rec) {
    rec->n_events = rec->n_crossings = rec->n_sampled = 0;
    if (scene->n <= 4) {
        Solver<1> solver(*scene);
        solver.run(t_end, 1, nullptr, nullptr, rec);
        return solver.trouble;
    }
    Solver<2> solver(*scene);
    solver.run(t_end, 1, nullptr, nullptr, rec);
    return solver.trouble;
}

// Linearised forward sliding on the contact coordinates: A (k, k) with k = 2 (n - 1); rows of (l = (1 - sigma mu kappa) N
// over its value at the equilibrium) and v_t over the belt speed; push, how a friction force accelerates; the equilibrium;
// constants (l at the equilibrium, kappa, sigma). Returns whether there is an equilibrium.
int linearised(const SceneData* scene, double* A, double* rows, double* push, double* q_eq, double* constants) {
    Mechanics m(*scene);
    const SceneData& s = *scene;
    int n = s.n, nc = m.nc, k = 2 * nc;
    for (int i = 0; i < n; i++) q_eq[i] = (double)m.q_eq[i];
    constants[0] = (double)m.N0, constants[1] = (double)m.kappa, constants[2] = m.sigma0, constants[3] = (double)m.omega;
    if (!m.has_equilibrium) return 0;
    double mu = m.mu(std::fabs(s.belt)), gain = 1 - m.sigma0 * mu * (double)m.kappa;
    double slope = s.falling ? s.decay * (mu - s.mu_d) : 0;  // d mu / d(sigma v_t), as the slip speed falls with it
    for (int j = 0; j < k; j++) {
        real x[NMAX] = {}, v[NMAX] = {}, a[NMAX], N, T;
        (j < nc ? x : v)[m.c[j % nc]] = 1;
        m.forces(SLIDE, m.sigma0 * mu, x, v, 0, s.force, a, N, T);
        // T = phi(mu) l with phi = sigma mu / (1 - sigma mu kappa): d phi / d mu = sigma / gain^2, l = gain N0
        double dT = v[m.it] != 0 ? (double)m.N0 * slope / gain : 0;
        for (int i = 0; i < nc; i++) {
            A[i * k + j] = (double)v[m.c[i]];
            A[(nc + i) * k + j] = (double)(a[m.c[i]] + m.pull[i] * dT);
        }
        rows[j] = (double)(N / m.N0);
        rows[k + j] = (double)(v[m.it] / s.belt);
        push[j] = j < nc ? 0 : (double)m.pull[j - nc];
    }
    return 1;
}
}
