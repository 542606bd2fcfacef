/* Hand-written integrators for one processor core: what the package's speed is measured against.

The map is (12)-(13) of the paper with W = -q0,

    p1 = p0 - h dH/dq(q0, p1) - h eps q0,      q1 = q0 + h dH/dp(q0, p1),

for the Hamiltonians

    oscillator    (p^2 + q^2)/2                                         explicit
    kepler        |p|^2/2 - 1/|q|                                       explicit
    product       (q^2 + 1)(p^2 + 1)/2                                  implicit, n = 1
    pendulum      two unit masses on unit rods, unit gravity            implicit, n = 2
    chain         sum (1 + A q_i^2) p_i^2/2 + B sum q_i q_i+1 p_i p_i+1
                  + sum (d_i^2/2 + C d_i^4/4), d_i = q_i - q_i-1, ends fixed
    web           the same with B over all pairs: a full Jacobian
    mirror        a charged particle between magnetic mirrors, |p - A|^2/2 with the vector
                  potential A = (1 + (z/LENGTH)^2)/2 (-y, x, 0); (13) is linear in p1
    boris         the same particle by the method of Boris, in q and v = p - A

and, for the pendulum, two methods of order 4: `pendulum_gauss` is Gauss-Legendre collocation with
two stages, `pendulum_yoshida` composes three Strang steps, each of the map and its adjoint.

An implicit step starts from the explicit guess p0 - h dH/dq(q0, p0) - h eps q0 and makes a given
number of Newton iterations; the caller asks (`correction` not NULL) how large the last one was.

Arrays are of doubles, one row of lanes for each component: q[i*lanes + l]. A few vectors of lanes
stay in registers over the whole time loop; `lanes` must be a multiple of BLOCK. The same steps are compiled twice, for vectors and for
single numbers (`_one`, with lanes = 1), by including this file from within itself. */

#ifndef REAL

#include <math.h>
#include <stddef.h>
#if defined(__AVX__)
#include <immintrin.h>
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif

#define INLINE static inline __attribute__((always_inline))
#define UNROLL _Pragma("GCC unroll 16")

#define A 0.5
#define B 0.25
#define C 0.3
#define LENGTH 20.0 /* magnetic mirror */
#define LONGEST 10 /* chain */

enum coupling { NEIGHBOURS, ALL_PAIRS };
enum solver { DENSE, TRIDIAGONAL };

/* One vector register of doubles. */
#if defined(__AVX512F__)
#define WIDTH 8
#elif defined(__AVX__)
#define WIDTH 4
#else
#define WIDTH 2
#endif

typedef double vector __attribute__((vector_size(WIDTH * sizeof(double))));
typedef long long bits __attribute__((vector_size(WIDTH * sizeof(double))));

INLINE vector vector_abs(vector x)
{
    return (vector)((bits)x & 0x7fffffffffffffffLL);
}

/* The language has no square root and no maximum of vectors; the instruction sets have. */
#if defined(__AVX512F__)
INLINE vector vector_sqrt(vector x) { return (vector)_mm512_sqrt_pd((__m512d)x); }
INLINE vector vector_max(vector x, vector y) { return (vector)_mm512_max_pd((__m512d)x, (__m512d)y); }
#elif defined(__AVX__)
INLINE vector vector_sqrt(vector x) { return (vector)_mm256_sqrt_pd((__m256d)x); }
INLINE vector vector_max(vector x, vector y) { return (vector)_mm256_max_pd((__m256d)x, (__m256d)y); }
#elif defined(__aarch64__)
INLINE vector vector_sqrt(vector x) { return (vector)vsqrtq_f64((float64x2_t)x); }
INLINE vector vector_max(vector x, vector y)
{
    return (vector)vmaxq_f64((float64x2_t)x, (float64x2_t)y);
}
#else
INLINE vector vector_sqrt(vector x)
{
    for (int i = 0; i < WIDTH; i++)
        x[i] = sqrt(x[i]);
    return x;
}
INLINE vector vector_max(vector x, vector y)
{
    for (int i = 0; i < WIDTH; i++)
        x[i] = x[i] > y[i] ? x[i] : y[i];
    return x;
}
#endif

/* glibc's vector library by the names that the vector ABI gives its functions, if it is there. */
#if defined(HAVE_LIBMVEC)
#if WIDTH == 8
#define VECTOR_ABI(f) _ZGVeN8v_##f
#elif WIDTH == 4 && defined(__AVX2__)
#define VECTOR_ABI(f) _ZGVdN4v_##f
#elif WIDTH == 4
#define VECTOR_ABI(f) _ZGVcN4v_##f
#elif defined(__aarch64__)
#define VECTOR_ABI(f) _ZGVnN2v_##f
#else
#define VECTOR_ABI(f) _ZGVbN2v_##f
#endif
vector VECTOR_ABI(sin)(vector);
vector VECTOR_ABI(cos)(vector);
#define vector_sin VECTOR_ABI(sin)
#define vector_cos VECTOR_ABI(cos)
#else
INLINE vector vector_sin(vector x)
{
    for (int i = 0; i < WIDTH; i++)
        x[i] = sin(x[i]);
    return x;
}
INLINE vector vector_cos(vector x)
{
    for (int i = 0; i < WIDTH; i++)
        x[i] = cos(x[i]);
    return x;
}
#endif

INLINE vector vector_load(const double *from)
{
    vector x;
    __builtin_memcpy(&x, from, sizeof x);
    return x;
}
INLINE void vector_store(double *to, vector x) { __builtin_memcpy(to, &x, sizeof x); }
INLINE double double_load(const double *from) { return *from; }
INLINE void double_store(double *to, double x) { *to = x; }
INLINE double double_max(double x, double y) { return x > y ? x : y; }

/* Any number of vectors that advance together divides it. */
#define BLOCK 64
int block(void) { return BLOCK; }

/* How wide the vectors in use are, and where sines come from: for the report. */
int vector_width(void) { return WIDTH; }
int has_libmvec(void)
{
#if defined(HAVE_LIBMVEC)
    return 1;
#else
    return 0;
#endif
}

#define REAL vector
#define NAME(function) function
#define LANES_OF_REAL WIDTH
#define ABS vector_abs
#define SQRT vector_sqrt
#define MAX vector_max
#define SIN vector_sin
#define COS vector_cos
#define LOAD vector_load
#define STORE vector_store
/* Vectors that advance together, to fill the pipelines: as many as the registers hold. */
#if defined(__AVX512F__) || defined(__aarch64__)
#define TOGETHER(few, many) (many)
#else
#define TOGETHER(few, many) (few)
#endif
#include "baseline.c"
#undef REAL
#undef NAME
#undef LANES_OF_REAL
#undef ABS
#undef SQRT
#undef MAX
#undef SIN
#undef COS
#undef LOAD
#undef STORE
#undef TOGETHER

#define REAL double
#define NAME(function) function##_one
#define LANES_OF_REAL 1
#define ABS fabs
#define SQRT sqrt
#define MAX double_max
#define SIN sin
#define COS cos
#define LOAD double_load
#define STORE double_store
#define TOGETHER(few, many) 1
#include "baseline.c"

#else /* ------------------------- from here on compiled once for each REAL ------------------- */

/* Steps: q, p -> q1, p1 in place. `kick` is h eps; the last correction is left in `correction`. */

INLINE void NAME(oscillator_step)(REAL *q, REAL *p, double h, double kick)
{
    p[0] -= (h + kick) * q[0];
    q[0] += h * p[0];
}

INLINE void NAME(kepler_step)(REAL *q, REAL *p, double h, double kick)
{
    REAL square = q[0] * q[0] + q[1] * q[1];
    REAL pull = h / (square * SQRT(square)) + kick;
    p[0] -= pull * q[0];
    p[1] -= pull * q[1];
    q[0] += h * p[0];
    q[1] += h * p[1];
}

/* The same steps, and the energy after them. What one step has computed of the potential the next
   one uses for the force: it is kept in `potential`. */

INLINE REAL NAME(oscillator_potential)(const REAL *q) { return 0.5 * q[0] * q[0]; }

INLINE REAL NAME(oscillator_watched)(REAL *q, REAL *p, REAL *potential, double h, double kick)
{
    NAME(oscillator_step)(q, p, h, kick);
    *potential = NAME(oscillator_potential)(q);
    return 0.5 * p[0] * p[0] + *potential;
}

INLINE REAL NAME(kepler_potential)(const REAL *q)
{
    return -1.0 / SQRT(q[0] * q[0] + q[1] * q[1]);
}

INLINE REAL NAME(kepler_watched)(REAL *q, REAL *p, REAL *potential, double h, double kick)
{
    REAL pull = kick - h * *potential * *potential * *potential;
    p[0] -= pull * q[0];
    p[1] -= pull * q[1];
    q[0] += h * p[0];
    q[1] += h * p[1];
    *potential = NAME(kepler_potential)(q);
    return 0.5 * (p[0] * p[0] + p[1] * p[1]) + *potential;
}

/* dH/dq = q (p^2 + 1), dH/dp = p (q^2 + 1). */
INLINE void NAME(product_step)(REAL *q, REAL *p, double h, double kick, int iterations,
                               REAL *correction)
{
    REAL hq = h * q[0];
    REAL known = p[0] - hq - kick * q[0];
    REAL x = known - hq * p[0] * p[0];
    REAL d = x;
    for (int k = 0; k < iterations; k++) {
        d = (x - known + hq * x * x) / (1.0 + 2.0 * hq * x);
        x -= d;
    }
    correction[0] = ABS(d);
    p[0] = x;
    q[0] += h * x * (q[0] * q[0] + 1.0);
}

/* With d = q_0 - q_1, D = 1/(1 + sin^2 d) and M = u^2 + 2 v^2 - 2 u v cos d, the kinetic energy is
   T = M D/2, and T' = u v sin d D - M sin d cos d D^2 is its derivative by d. */
INLINE void NAME(pendulum_step)(REAL *q, REAL *p, double h, double kick, int iterations,
                                REAL *correction)
{
    REAL s = SIN(q[0] - q[1]), c = COS(q[0] - q[1]);
    REAL D = 1.0 / (1.0 + s * s);
    REAL first = h * s * D, second = first * c * D;
    REAL known0 = p[0] - 2.0 * h * SIN(q[0]) - kick * q[0];
    REAL known1 = p[1] - h * SIN(q[1]) - kick * q[1];

    REAL u = p[0], v = p[1];
    REAL slope = first * (u * v) - second * (u * u + 2.0 * v * (v - u * c)); /* h T' */
    REAL du = u, dv = v;
    u = known0 - slope;
    v = known1 + slope;
    for (int k = 0; k < iterations; k++) {
        slope = first * (u * v) - second * (u * u + 2.0 * v * (v - u * c));
        REAL by_u = first * v - 2.0 * second * (u - v * c);
        REAL by_v = first * u - 2.0 * second * (2.0 * v - u * c);
        REAL F0 = u - known0 + slope, F1 = v - known1 - slope;
        /* [1 + by_u, by_v; -by_u, 1 - by_v] (du, dv) = (F0, F1) */
        REAL inverse = 1.0 / (1.0 + by_u - by_v);
        du = ((1.0 - by_v) * F0 - by_v * F1) * inverse;
        dv = ((1.0 + by_u) * F1 + by_u * F0) * inverse;
        u -= du;
        v -= dv;
    }
    correction[0] = MAX(ABS(du), ABS(dv));
    p[0] = u;
    p[1] = v;
    q[0] += h * D * (u - v * c);
    q[1] += h * D * (2.0 * v - u * c);
}

/* around_i = sum of w_j over the j that i is coupled to. */
INLINE void NAME(around)(int n, enum coupling coupling, const REAL *w, REAL *sum)
{
    REAL none = 0.0 * w[0], total = none;
    UNROLL for (int i = 0; i < n; i++)
        total += w[i];
    UNROLL for (int i = 0; i < n; i++)
        if (coupling == ALL_PAIRS)
            sum[i] = total - w[i];
        else
            sum[i] = (i > 0 ? w[i - 1] : none) + (i < n - 1 ? w[i + 1] : none);
}

/* F <- J^-1 F by elimination without pivoting, J being near the identity. */
INLINE void NAME(solve)(int n, REAL J[LONGEST][LONGEST], REAL *F)
{
    if (n == 2) { /* one division instead of two */
        REAL inverse = 1.0 / (J[0][0] * J[1][1] - J[0][1] * J[1][0]);
        REAL F0 = (J[1][1] * F[0] - J[0][1] * F[1]) * inverse;
        F[1] = (J[0][0] * F[1] - J[1][0] * F[0]) * inverse;
        F[0] = F0;
        return;
    }
    UNROLL for (int c = 0; c < n; c++) {
        REAL pivot = 1.0 / J[c][c];
        UNROLL for (int i = c + 1; i < n; i++) {
            REAL m = J[i][c] * pivot;
            UNROLL for (int j = c + 1; j < n; j++)
                J[i][j] -= m * J[c][j];
            F[i] -= m * F[c];
        }
        J[c][c] = pivot;
    }
    UNROLL for (int i = n - 1; i >= 0; i--) {
        UNROLL for (int j = i + 1; j < n; j++)
            F[i] -= J[i][j] * F[j];
        F[i] *= J[i][i];
    }
}

INLINE void NAME(solve_tridiagonal)(int n, const REAL *below, REAL *diagonal, const REAL *above,
                                    REAL *F)
{
    diagonal[0] = 1.0 / diagonal[0];
    UNROLL for (int i = 1; i < n; i++) {
        REAL m = below[i] * diagonal[i - 1];
        diagonal[i] = 1.0 / (diagonal[i] - m * above[i - 1]);
        F[i] -= m * F[i - 1];
    }
    F[n - 1] *= diagonal[n - 1];
    UNROLL for (int i = n - 2; i >= 0; i--)
        F[i] = (F[i] - above[i] * F[i + 1]) * diagonal[i];
}

/* With w_i = q_i x_i and s_i = sum of the w_j around i,
   dH/dq_i = x_i (A w_i + B s_i) + V_i,    dH/dp_i = x_i + q_i (A w_i + B s_i). */
INLINE void NAME(chain_step)(int n, enum coupling coupling, enum solver solver, REAL *q, REAL *p,
                             double h, double kick, int iterations, REAL *correction)
{
    REAL x[LONGEST], w[LONGEST], s[LONGEST], F[LONGEST], known[LONGEST];
    REAL none = 0.0 * q[0], spring = q[0] + C * q[0] * q[0] * q[0];
    UNROLL for (int i = 0; i < n; i++) {
        REAL d = (i < n - 1 ? q[i + 1] : none) - q[i];
        REAL next = d + C * d * d * d;
        known[i] = p[i] - h * (spring - next) - kick * q[i];
        spring = next;
        w[i] = q[i] * p[i];
    }
    NAME(around)(n, coupling, w, s);
    UNROLL for (int i = 0; i < n; i++)
        F[i] = x[i] = known[i] - h * p[i] * (A * w[i] + B * s[i]);

    for (int k = 0; k < iterations; k++) {
        UNROLL for (int i = 0; i < n; i++)
            w[i] = q[i] * x[i];
        NAME(around)(n, coupling, w, s);
        REAL diagonal[LONGEST];
        UNROLL for (int i = 0; i < n; i++) {
            F[i] = x[i] - known[i] + h * x[i] * (A * w[i] + B * s[i]);
            diagonal[i] = 1.0 + h * (2.0 * A * w[i] + B * s[i]);
        }
        if (solver == TRIDIAGONAL) {
            REAL below[LONGEST], above[LONGEST];
            UNROLL for (int i = 0; i < n; i++) {
                if (i > 0)
                    below[i] = h * B * x[i] * q[i - 1];
                if (i < n - 1)
                    above[i] = h * B * x[i] * q[i + 1];
            }
            NAME(solve_tridiagonal)(n, below, diagonal, above, F);
        } else {
            REAL J[LONGEST][LONGEST];
            UNROLL for (int i = 0; i < n; i++) {
                UNROLL for (int j = 0; j < n; j++)
                    if (j == i)
                        J[i][j] = diagonal[i];
                    else if (coupling == ALL_PAIRS || j == i - 1 || j == i + 1)
                        J[i][j] = h * B * x[i] * q[j];
                    else
                        J[i][j] = none;
            }
            NAME(solve)(n, J, F);
        }
        UNROLL for (int i = 0; i < n; i++)
            x[i] -= F[i];
    }
    correction[0] = ABS(F[0]);
    UNROLL for (int i = 0; i < n; i++) {
        correction[0] = MAX(correction[0], ABS(F[i]));
        w[i] = q[i] * x[i];
    }
    NAME(around)(n, coupling, w, s);
    UNROLL for (int i = 0; i < n; i++) {
        p[i] = x[i];
        q[i] += h * (x[i] + q[i] * (A * w[i] + B * s[i]));
    }
}

/* Two stages z + y_i, i = 1, 2, with z = (q, p), f(q, p) = (dH/dp, -dH/dq - eps q) and y = h a f:
   with a^-1 = [3, BACK; -AHEAD, 3], BACK AHEAD = 3, Newton's method solves

       3 y_1 + BACK y_2 - h f(z + y_1) = 0,    -AHEAD y_1 + 3 y_2 - h f(z + y_2) = 0,

   and the step is z + sqrt(3) (y_2 - y_1). The first one starts from y_i = c_i h f(z), the others
   from the parabola through z and the stages of the step before. */
#define MOST 8 /* vectors together */
#define ROOT3 1.7320508075688772
#define BACK (2.0 * ROOT3 - 3.0)
#define AHEAD (2.0 * ROOT3 + 3.0)
#define NODE1 (0.5 - ROOT3 / 6.0)
#define NODE2 (0.5 + ROOT3 / 6.0)
/* That parabola at 1 + c: c1 c2 = 1/6, c2 - c1 = 1/sqrt(3). */
#define EXTRAPOLATED(c, y1, y2)                                                                    \
    ((1.0 + (c)) * ROOT3 * (6.0 * NODE1 * (1.0 + (c) - NODE1) * (y2)                               \
                            - 6.0 * NODE2 * (1.0 + (c) - NODE2) * (y1)))

/* h f at a state, and the nonzero second derivatives of H, times h. With d = q_0 - q_1 as in
   `pendulum_step`: `of_d` is d2T/dd2, `mixed` is d2T/dp dd, `mass` and `cross` are entries D and
   -D cos d of d2T/dp2, `fall` is d2V/dq2 + eps. */
typedef struct {
    REAL f[4], mixed[2], of_d, mass, cross, fall[2];
} NAME(rates);

INLINE void NAME(pendulum_rates)(const REAL *q, const REAL *p, double h, double kick,
                                 NAME(rates) *at)
{
    REAL s0 = SIN(q[0]), c0 = COS(q[0]), s1 = SIN(q[1]), c1 = COS(q[1]);
    REAL s = s0 * c1 - c0 * s1, c = c0 * c1 + s0 * s1;
    REAL D = 1.0 / (1.0 + s * s), hD = h * D, turn = s * c * D; /* dD/dd = -2 turn D */
    REAL w0 = p[0] - c * p[1], w1 = 2.0 * p[1] - c * p[0];
    REAL product = p[0] * p[1], M = p[0] * w0 + p[1] * w1;
    REAL slope = hD * (s * product - turn * M);
    at->f[0] = hD * w0;
    at->f[1] = hD * w1;
    at->f[2] = -slope - 2.0 * h * s0 - kick * q[0];
    at->f[3] = slope - h * s1 - kick * q[1];
    at->mixed[0] = hD * (s * p[1] - 2.0 * turn * w0);
    at->mixed[1] = hD * (s * p[0] - 2.0 * turn * w1);
    at->of_d = hD * (product * (c - 4.0 * turn * s)
                     - M * (D * (c * c - s * s) - 4.0 * turn * turn));
    at->mass = hD;
    at->cross = -c * hD;
    at->fall[0] = 2.0 * h * c0 + kick;
    at->fall[1] = h * c1 + kick;
}

INLINE void NAME(stage_rates)(const REAL *q, const REAL *p, const REAL *y, double h, double kick,
                              NAME(rates) *at)
{
    REAL Q[2] = {q[0] + y[0], q[1] + y[1]}, P[2] = {p[0] + y[2], p[1] + y[3]};
    NAME(pendulum_rates)(Q, P, h, kick, at);
}

/* (3 - h df) x, with df the Jacobian of f. */
INLINE void NAME(stage_times)(const NAME(rates) *at, const REAL *x, REAL *out)
{
    REAL e = x[0] - x[1];
    REAL slope = at->of_d * e + at->mixed[0] * x[2] + at->mixed[1] * x[3];
    out[0] = 3.0 * x[0] - at->mixed[0] * e - at->mass * x[2] - at->cross * x[3];
    out[1] = 3.0 * x[1] - at->mixed[1] * e - at->cross * x[2] - 2.0 * at->mass * x[3];
    out[2] = 3.0 * x[2] + slope + at->fall[0] * x[0];
    out[3] = 3.0 * x[3] - slope + at->fall[1] * x[1];
}

/* Correct y1 and y2 once; the size of the correction. */
INLINE REAL NAME(gauss_correct)(const NAME(rates) *one, const NAME(rates) *two, REAL *y1, REAL *y2)
{
    REAL r1[4], r2[4], d1[4], d2[4], J[LONGEST][LONGEST];
    UNROLL for (int i = 0; i < 4; i++) {
        r1[i] = 3.0 * y1[i] + BACK * y2[i] - one->f[i];
        r2[i] = 3.0 * y2[i] - AHEAD * y1[i] - two->f[i];
    }
    /* Without d2: [(3 - h df_2) (3 - h df_1) + 3] d1 = (3 - h df_2) r1 - BACK r2 */
    UNROLL for (int j = 0; j < 4; j++) {
        REAL unit[4], column[4], out[4];
        UNROLL for (int i = 0; i < 4; i++)
            unit[i] = (i == j ? 1.0 : 0.0) + 0.0 * y1[0];
        NAME(stage_times)(one, unit, column);
        NAME(stage_times)(two, column, out);
        UNROLL for (int i = 0; i < 4; i++)
            J[i][j] = out[i] + 3.0 * unit[i];
    }
    NAME(stage_times)(two, r1, d1);
    UNROLL for (int i = 0; i < 4; i++)
        d1[i] -= BACK * r2[i];
    NAME(solve)(4, J, d1);
    NAME(stage_times)(one, d1, d2);
    REAL largest = ABS(d1[0]);
    UNROLL for (int i = 0; i < 4; i++) {
        d2[i] = (r1[i] - d2[i]) * (1.0 / BACK);
        y1[i] -= d1[i];
        y2[i] -= d2[i];
        largest = MAX(largest, MAX(ABS(d1[i]), ABS(d2[i])));
    }
    return largest;
}

INLINE void NAME(pendulum_gauss_start)(int many, REAL (*q)[2], REAL (*p)[2], double h, double kick,
                                       REAL (*guess)[8])
{
    UNROLL for (int b = 0; b < many; b++) {
        NAME(rates) at;
        NAME(pendulum_rates)(q[b], p[b], h, kick, &at);
        UNROLL for (int i = 0; i < 4; i++) {
            guess[b][i] = NODE1 * at.f[i];
            guess[b][i + 4] = NODE2 * at.f[i];
        }
    }
}

INLINE void NAME(pendulum_gauss_step)(int many, REAL (*q)[2], REAL (*p)[2], REAL (*guess)[8],
                                      double h, double kick, int iterations, REAL *correction)
{
    REAL y1[MOST][4], y2[MOST][4];
    UNROLL for (int b = 0; b < many; b++)
        UNROLL for (int i = 0; i < 4; i++) {
            y1[b][i] = guess[b][i];
            y2[b][i] = guess[b][i + 4];
        }
    for (int k = 0; k < iterations; k++) {
        NAME(rates) one[MOST], two[MOST];
        UNROLL for (int b = 0; b < many; b++) {
            NAME(stage_rates)(q[b], p[b], y1[b], h, kick, &one[b]);
            NAME(stage_rates)(q[b], p[b], y2[b], h, kick, &two[b]);
        }
        UNROLL for (int b = 0; b < many; b++)
            correction[b] = NAME(gauss_correct)(&one[b], &two[b], y1[b], y2[b]);
    }
    UNROLL for (int b = 0; b < many; b++)
        UNROLL for (int i = 0; i < 4; i++) {
            REAL change = ROOT3 * (y2[b][i] - y1[b][i]), *z = i < 2 ? &q[b][i] : &p[b][i - 2];
            *z += change;
            guess[b][i] = EXTRAPOLATED(NODE1, y1[b][i], y2[b][i]) - change;
            guess[b][i + 4] = EXTRAPOLATED(NODE2, y1[b][i], y2[b][i]) - change;
        }
}

/* Yoshida's composition: the map over r h, then its adjoint over r h, for r = GAMMA/2, 1/2 - GAMMA
   and GAMMA/2. (13) changes both momenta by one slope x, to known_0 - x and known_1 + x; (12) of
   the adjoint depends on d alone. Newton's method solves for x, then for d. The next map starts
   with the sines that the adjoint ended with: `sines` holds sin d, cos d, D, sin q_0, sin q_1. */
#define GAMMA 1.3512071919596578 /* 1/(2 - 2^(1/3)) */

INLINE void NAME(pendulum_yoshida_start)(int many, REAL (*q)[2], REAL (*p)[2], double h,
                                         double kick, REAL (*sines)[5])
{
    UNROLL for (int b = 0; b < many; b++) {
        REAL s = SIN(q[b][0] - q[b][1]);
        sines[b][0] = s;
        sines[b][1] = COS(q[b][0] - q[b][1]);
        sines[b][2] = 1.0 / (1.0 + s * s);
        sines[b][3] = SIN(q[b][0]);
        sines[b][4] = SIN(q[b][1]);
    }
}

INLINE void NAME(pendulum_strang)(int many, REAL (*q)[2], REAL (*p)[2], REAL (*sines)[5], double h,
                                  double kick, int iterations, REAL *correction)
{
    REAL d0[MOST], move[MOST], last[MOST], sine[MOST], cosine[MOST];
    UNROLL for (int b = 0; b < many; b++) {
        REAL s = sines[b][0], c = sines[b][1], D = sines[b][2];
        REAL first = h * s * D, second = first * c * D;
        REAL known0 = p[b][0] - 2.0 * h * sines[b][3] - kick * q[b][0];
        REAL known1 = p[b][1] - h * sines[b][4] - kick * q[b][1];
        REAL u = known0, v = known1, w0 = u - v * c, w1 = 2.0 * v - u * c;
        REAL x = first * (u * v) - second * (u * w0 + v * w1), delta = x;
        for (int k = 0; k < iterations; k++) {
            u = known0 - x;
            v = known1 + x;
            w0 = u - v * c;
            w1 = 2.0 * v - u * c;
            REAL F = x - first * (u * v) + second * (u * w0 + v * w1);
            delta = F / (1.0 + first * (v - u) - 2.0 * second * (w0 - w1));
            x -= delta;
        }
        correction[b] = ABS(delta);
        p[b][0] = u = known0 - x;
        p[b][1] = v = known1 + x;
        REAL move0 = h * D * (u - v * c), move1 = h * D * (2.0 * v - u * c);
        q[b][0] += move0;
        q[b][1] += move1;
        d0[b] = q[b][0] - q[b][1];
        /* The adjoint's guess: as far again, at a rate that is linear in d. */
        REAL again = move0 - move1;
        move[b] = again - 2.0 * again * s * (h * D * (u - v) + 2.0 * c * D * again);
    }

    /* d = d0 + h D (u - 2 v + (u - v) cos d), with both sides multiplied by 1/D = 1 + sin^2 d. */
    for (int k = 0; k < iterations; k++) {
        UNROLL for (int b = 0; b < many; b++) {
            sine[b] = SIN(d0[b] + move[b]);
            cosine[b] = COS(d0[b] + move[b]);
        }
        UNROLL for (int b = 0; b < many; b++) {
            REAL s = sine[b], c = cosine[b], less = h * (p[b][0] - p[b][1]);
            REAL E = 1.0 + s * s, g = less * (1.0 + c) - h * p[b][1];
            last[b] = E * (E * move[b] - g) / (E * E + s * (2.0 * c * g + less * E));
            move[b] -= last[b];
        }
    }
    UNROLL for (int b = 0; b < many; b++) {
        REAL u = p[b][0], v = p[b][1], delta = last[b], half = 0.5 * delta * delta;
        REAL s = sine[b] - delta * cosine[b] - half * sine[b]; /* sin(d - delta) */
        REAL c = cosine[b] + delta * sine[b] - half * cosine[b];
        REAL D = 1.0 / (1.0 + s * s);
        correction[b] = MAX(correction[b], ABS(delta));
        q[b][0] += h * D * (u - v * c);
        q[b][1] += h * D * (2.0 * v - u * c);
        sines[b][0] = s;
        sines[b][1] = c;
        sines[b][2] = D;
    }
    UNROLL for (int b = 0; b < many; b++) {
        sines[b][3] = SIN(q[b][0]);
        sines[b][4] = SIN(q[b][1]);
    }
    UNROLL for (int b = 0; b < many; b++) {
        REAL s = sines[b][0], c = sines[b][1], D = sines[b][2], u = p[b][0], v = p[b][1];
        REAL slope = h * s * D * (u * v - c * D * (u * (u - v * c) + v * (2.0 * v - u * c)));
        p[b][0] = u - slope - 2.0 * h * sines[b][3] - kick * q[b][0];
        p[b][1] = v + slope - h * sines[b][4] - kick * q[b][1];
    }
}

INLINE void NAME(pendulum_yoshida_step)(int many, REAL (*q)[2], REAL (*p)[2], REAL (*sines)[5],
                                        double h, double kick, int iterations, REAL *correction)
{
    UNROLL for (int b = 0; b < many; b++)
        correction[b] = 0.0 * q[b][0];
    for (int part = 0; part < 3; part++) {
        double r = part == 1 ? 0.5 - GAMMA : 0.5 * GAMMA;
        REAL largest[MOST];
        NAME(pendulum_strang)(many, q, p, sines, r * h, r * kick, iterations, largest);
        UNROLL for (int b = 0; b < many; b++)
            correction[b] = MAX(correction[b], largest[b]);
    }
}

/* With the velocity v = p1 - A(q0) and g = (1 + (z/LENGTH)^2)/2, (13) is the linear system
   v0 = a + h g v1, v1 = b - h g v0, which one iteration of Newton's method solves as well. */
INLINE void NAME(mirror_step)(REAL *q, REAL *p, double h, double kick)
{
    REAL z = q[2] * (1.0 / LENGTH), g = 0.5 + 0.5 * z * z, hg = h * g;
    REAL a = p[0] + g * q[1] - kick * q[0], b = p[1] - g * q[0] - kick * q[1];
    REAL inverse = 1.0 / (1.0 + hg * hg);
    REAL v0 = (a + hg * b) * inverse, v1 = (b - hg * a) * inverse;
    p[0] = v0 - g * q[1];
    p[1] = v1 + g * q[0];
    p[2] += (h / LENGTH) * z * (q[0] * v1 - q[1] * v0) - kick * q[2];
    q[0] += h * v0;
    q[1] += h * v1;
    q[2] += h * p[2];
}

/* v = p - A(q), or p = v + A(q) with the other sign. */
INLINE void NAME(boris_change)(const REAL *q, REAL *p, double sign)
{
    REAL z = q[2] * (1.0 / LENGTH), g = sign * (0.5 + 0.5 * z * z);
    p[0] -= g * q[1];
    p[1] += g * q[0];
}

INLINE void NAME(boris_drift)(REAL *q, const REAL *v, double h)
{
    UNROLL for (int i = 0; i < 3; i++)
        q[i] += h * v[i];
}

/* Half a kick, the rotation by the vector t = h B/2 of Cayley's form, half a kick. */
INLINE void NAME(boris_step)(REAL *q, REAL *v, double h, double kick)
{
    REAL z = q[2] * (0.5 * h / (LENGTH * LENGTH)), half = z * q[2] + 0.5 * h;
    REAL t[3] = {-z * q[0], -z * q[1], half}, u[3], w[3];
    UNROLL for (int i = 0; i < 3; i++)
        u[i] = v[i] - 0.5 * kick * q[i];
    w[0] = u[0] + u[1] * t[2] - u[2] * t[1];
    w[1] = u[1] + u[2] * t[0] - u[0] * t[2];
    w[2] = u[2] + u[0] * t[1] - u[1] * t[0];
    REAL scale = 2.0 / (1.0 + t[0] * t[0] + t[1] * t[1] + t[2] * t[2]);
    UNROLL for (int i = 0; i < 3; i++)
        t[i] *= scale;
    v[0] = u[0] + w[1] * t[2] - w[2] * t[1] - 0.5 * kick * q[0];
    v[1] = u[1] + w[2] * t[0] - w[0] * t[2] - 0.5 * kick * q[1];
    v[2] = u[2] + w[0] * t[1] - w[1] * t[0] - 0.5 * kick * q[2];
    NAME(boris_drift)(q, v, h);
}

/* Runs: the loops over lanes and time around a step. Lane `AT(b)` is the first of vector b. */

#define AT(b) (first + (b) * LANES_OF_REAL)

#define FOR_EACH_COMPONENT(n, many)                                                                \
    UNROLL for (int b = 0; b < (many); b++)                                                        \
        UNROLL for (int i = 0; i < (n); i++)

#define LOAD_STATE(n, many)                                                                        \
    REAL q[many][n], p[many][n];                                                                   \
    FOR_EACH_COMPONENT(n, many)                                                                    \
    {                                                                                              \
        q[b][i] = LOAD(q0 + i * lanes + AT(b));                                              \
        p[b][i] = LOAD(p0 + i * lanes + AT(b));                                              \
    }

#define STORE_STATE(n, many, to_q, to_p)                                                           \
    FOR_EACH_COMPONENT(n, many)                                                                    \
    {                                                                                              \
        STORE((to_q) + i * lanes + AT(b), q[b][i]);                                                \
        STORE((to_p) + i * lanes + AT(b), p[b][i]);                                                \
    }

/* The state after the last step. */
#define DEFINE_EXPLICIT_FINAL(system, n, many)                                                     \
    void NAME(system##_final)(long lanes, long steps, double h, double eps, const double *q0,      \
                              const double *p0, double *q1, double *p1)                            \
    {                                                                                              \
        for (long first = 0; first < lanes; first += (many) * LANES_OF_REAL) {                     \
            LOAD_STATE(n, many)                                                                    \
            for (long k = 0; k < steps; k++) {                                                     \
                UNROLL for (int b = 0; b < (many); b++)                                            \
                    NAME(system##_step)(q[b], p[b], h, h * eps);                                   \
            }                                                                                      \
            STORE_STATE(n, many, q1, p1)                                                           \
        }                                                                                          \
    }

/* The same in q and v, with the half drifts of neighbouring steps as one. */
#define DEFINE_BORIS_FINAL(many)                                                                   \
    void NAME(boris_final)(long lanes, long steps, double h, double eps, const double *q0,         \
                           const double *p0, double *q1, double *p1)                               \
    {                                                                                              \
        for (long first = 0; first < lanes; first += (many) * LANES_OF_REAL) {                     \
            LOAD_STATE(3, many)                                                                    \
            UNROLL for (int b = 0; b < (many); b++) {                                              \
                NAME(boris_change)(q[b], p[b], -1.0);                                              \
                NAME(boris_drift)(q[b], p[b], 0.5 * h);                                            \
            }                                                                                      \
            for (long k = 0; k < steps; k++) {                                                     \
                UNROLL for (int b = 0; b < (many); b++)                                            \
                    NAME(boris_step)(q[b], p[b], h, h * eps);                                      \
            }                                                                                      \
            UNROLL for (int b = 0; b < (many); b++) {                                              \
                NAME(boris_drift)(q[b], p[b], -0.5 * h);                                           \
                NAME(boris_change)(q[b], p[b], 1.0);                                               \
            }                                                                                      \
            STORE_STATE(3, many, q1, p1)                                                           \
        }                                                                                          \
    }

/* Energy E_k of the initial state, k = 0, and after each of N steps: max |E_k - E_0|, and its slope
   against time, sum (k - m)(E_k - E_0) / (h sum (k - m)^2) with m = N/2 and M (M^2 - 1)/12,
   M = N + 1, for that sum. */
#define DEFINE_EXPLICIT_STREAMED(system, n, many)                                                  \
    void NAME(system##_streamed)(long lanes, long steps, double h, double eps, const double *q0,   \
                                 const double *p0, double *q1, double *p1, double *drift,          \
                                 double *slope)                                                    \
    {                                                                                              \
        double M = steps + 1.0, scale = 12.0 / (h * M * (M * M - 1.0));                            \
        for (long first = 0; first < lanes; first += (many) * LANES_OF_REAL) {                     \
            LOAD_STATE(n, many)                                                                    \
            REAL V[many], start[many], largest[many], moment[many];                                \
            UNROLL for (int b = 0; b < (many); b++) {                                              \
                V[b] = NAME(system##_potential)(q[b]);                                             \
                start[b] = V[b];                                                                   \
                for (int i = 0; i < (n); i++)                                                      \
                    start[b] += 0.5 * p[b][i] * p[b][i];                                           \
                largest[b] = moment[b] = 0.0 * start[b];                                           \
            }                                                                                      \
            double weight = 1.0 - 0.5 * steps;                                                     \
            for (long k = 0; k < steps; k++) {                                                     \
                UNROLL for (int b = 0; b < (many); b++) {                                          \
                    REAL energy = NAME(system##_watched)(q[b], p[b], &V[b], h, h * eps);           \
                    REAL change = energy - start[b];                                               \
                    largest[b] = MAX(largest[b], ABS(change));                                     \
                    moment[b] += weight * change;                                                  \
                }                                                                                  \
                weight += 1.0;                                                                     \
            }                                                                                      \
            STORE_STATE(n, many, q1, p1)                                                           \
            UNROLL for (int b = 0; b < (many); b++) {                                              \
                STORE(drift + AT(b), largest[b]);                                                  \
                STORE(slope + AT(b), scale * moment[b]);                                           \
            }                                                                                      \
        }                                                                                          \
    }

/* The start and every m-th state: qs[s*n*lanes + i*lanes + l], s = 0, 1, ..., steps/m. */
#define DEFINE_EXPLICIT_SAVED(system, n, many)                                                     \
    void NAME(system##_saved)(long lanes, long steps, long every, double h, double eps,            \
                              const double *q0, const double *p0, double *qs, double *ps)          \
    {                                                                                              \
        for (long first = 0; first < lanes; first += (many) * LANES_OF_REAL) {                     \
            LOAD_STATE(n, many)                                                                    \
            STORE_STATE(n, many, qs, ps)                                                           \
            for (long s = 1; s <= steps / every; s++) {                                            \
                for (long k = 0; k < every; k++) {                                                 \
                    UNROLL for (int b = 0; b < (many); b++)                                        \
                        NAME(system##_step)(q[b], p[b], h, h * eps);                               \
                }                                                                                  \
                STORE_STATE(n, many, qs + s * (n) * lanes, ps + s * (n) * lanes)                   \
            }                                                                                      \
        }                                                                                          \
    }

/* The state after the last step; `correction` (or NULL) gets each lane's largest last correction
   of Newton's method. `step` may use q, p, h, kick, iterations, and leaves the last one in `d`. */
#define IMPLICIT_LOOP(many, step, monitor)                                                         \
    for (long k = 0; k < steps; k++)                                                               \
        UNROLL for (int b = 0; b < (many); b++) {                                                  \
            REAL d;                                                                                \
            step;                                                                                  \
            if (monitor)                                                                           \
                largest[b] = MAX(largest[b], d);                                                   \
        }

#define DEFINE_IMPLICIT(name, n, many, step)                                                       \
    void NAME(name)(long lanes, long steps, int iterations, double h, double eps,                  \
                    const double *q0, const double *p0, double *q1, double *p1,                    \
                    double *correction)                                                            \
    {                                                                                              \
        double kick = h * eps;                                                                     \
        for (long first = 0; first < lanes; first += (many) * LANES_OF_REAL) {                     \
            LOAD_STATE(n, many)                                                                    \
            REAL largest[many];                                                                    \
            UNROLL for (int b = 0; b < (many); b++)                                                \
                largest[b] = 0.0 * q[b][0];                                                        \
            if (correction) {                                                                      \
                IMPLICIT_LOOP(many, step, 1)                                                       \
                UNROLL for (int b = 0; b < (many); b++)                                            \
                    STORE(correction + AT(b), largest[b]);                                         \
            } else if (iterations == 2) { /* the usual number, known to the compiler */            \
                enum { iterations = 2 };                                                           \
                IMPLICIT_LOOP(many, step, 0)                                                       \
            } else {                                                                               \
                IMPLICIT_LOOP(many, step, 0)                                                       \
            }                                                                                      \
            STORE_STATE(n, many, q1, p1)                                                           \
        }                                                                                          \
    }

/* As DEFINE_IMPLICIT, for a step that advances all `many` vectors in lockstep, which hides the
   latency of a chain of sines and divisions. A step leaves `values` numbers to the next one in
   `left`; name_start sets them for the first. */
#define LOCKSTEP_LOOP(name, many, monitor)                                                         \
    for (long k = 0; k < steps; k++) {                                                             \
        REAL d[many];                                                                              \
        NAME(name##_step)(many, q, p, left, h, kick, iterations, d);                               \
        if (monitor)                                                                               \
            UNROLL for (int b = 0; b < (many); b++)                                                \
                largest[b] = MAX(largest[b], d[b]);                                                \
    }

#define DEFINE_LOCKSTEP(name, n, many, values)                                                     \
    void NAME(name)(long lanes, long steps, int iterations, double h, double eps,                  \
                    const double *q0, const double *p0, double *q1, double *p1,                    \
                    double *correction)                                                            \
    {                                                                                              \
        double kick = h * eps;                                                                     \
        for (long first = 0; first < lanes; first += (many) * LANES_OF_REAL) {                     \
            LOAD_STATE(n, many)                                                                    \
            REAL largest[many], left[many][values];                                                \
            NAME(name##_start)(many, q, p, h, kick, left);                                         \
            UNROLL for (int b = 0; b < (many); b++)                                                \
                largest[b] = 0.0 * q[b][0];                                                        \
            if (correction) {                                                                      \
                LOCKSTEP_LOOP(name, many, 1)                                                       \
                UNROLL for (int b = 0; b < (many); b++)                                            \
                    STORE(correction + AT(b), largest[b]);                                         \
            } else if (iterations == 2) { /* the usual number, known to the compiler */            \
                enum { iterations = 2 };                                                           \
                LOCKSTEP_LOOP(name, many, 0)                                                       \
            } else {                                                                               \
                LOCKSTEP_LOOP(name, many, 0)                                                       \
            }                                                                                      \
            STORE_STATE(n, many, q1, p1)                                                           \
        }                                                                                          \
    }

DEFINE_EXPLICIT_FINAL(oscillator, 1, TOGETHER(4, 8))
DEFINE_EXPLICIT_STREAMED(oscillator, 1, TOGETHER(2, 8))
DEFINE_EXPLICIT_SAVED(oscillator, 1, TOGETHER(4, 8))

DEFINE_EXPLICIT_FINAL(kepler, 2, TOGETHER(2, 8))
DEFINE_EXPLICIT_STREAMED(kepler, 2, TOGETHER(1, 4))
DEFINE_EXPLICIT_SAVED(kepler, 2, TOGETHER(2, 8))

DEFINE_IMPLICIT(product, 1, TOGETHER(2, 8), NAME(product_step)(q[b], p[b], h, kick, iterations, &d))
DEFINE_IMPLICIT(pendulum, 2, TOGETHER(1, 4),
                NAME(pendulum_step)(q[b], p[b], h, kick, iterations, &d))

DEFINE_LOCKSTEP(pendulum_gauss, 2, TOGETHER(2, 2), 8)
DEFINE_LOCKSTEP(pendulum_yoshida, 2, TOGETHER(4, 4), 5)
DEFINE_EXPLICIT_FINAL(mirror, 3, TOGETHER(2, 8))
DEFINE_BORIS_FINAL(TOGETHER(2, 8))

#define CHAIN_STEP(n, coupling, solver)                                                            \
    NAME(chain_step)(n, coupling, solver, q[b], p[b], h, kick, iterations, &d)
DEFINE_IMPLICIT(chain2, 2, TOGETHER(1, 4), CHAIN_STEP(2, NEIGHBOURS, DENSE))
DEFINE_IMPLICIT(chain4, 4, TOGETHER(1, 2), CHAIN_STEP(4, NEIGHBOURS, DENSE))
DEFINE_IMPLICIT(chain10, 10, 1, CHAIN_STEP(10, NEIGHBOURS, DENSE))
DEFINE_IMPLICIT(chain10_tridiagonal, 10, 1, CHAIN_STEP(10, NEIGHBOURS, TRIDIAGONAL))
DEFINE_IMPLICIT(web10, 10, 1, CHAIN_STEP(10, ALL_PAIRS, DENSE))

#undef AT
#undef FOR_EACH_COMPONENT
#undef LOAD_STATE
#undef STORE_STATE
#undef DEFINE_EXPLICIT_FINAL
#undef DEFINE_EXPLICIT_STREAMED
#undef DEFINE_EXPLICIT_SAVED
#undef IMPLICIT_LOOP
#undef DEFINE_IMPLICIT
#undef LOCKSTEP_LOOP
#undef DEFINE_LOCKSTEP
#undef MOST
#undef ROOT3
#undef BACK
#undef AHEAD
#undef NODE1
#undef NODE2
#undef EXTRAPOLATED
#undef GAMMA
#undef CHAIN_STEP
#endif
