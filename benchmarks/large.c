/* Runs of one trajectory with many coordinates, by hand: what large.py measures the package against.

The map is p1 = p0 - h dH/dq(q0, p1), q1 = q0 + h dH/dp(q0, p1), unless a method is named. All
functions have the same arguments: q, p (overwritten), sizes, steps, h, constants of the system, and
work, memory whose length large.py knows. */

#include <math.h>
#include <string.h>

#define ARGUMENTS double *restrict q, double *restrict p, const long *size, long steps, double h, \
                  const double *c, double *restrict work

/* The chain of Fermi, Pasta, Ulam and Tsingou, fixed ends: size n, every; c alpha, beta.
   With every > 0 each such state goes to work: all q, then all p. */
static double fput_force(double left, double right, double alpha, double beta)
{
    return right - left + alpha * (right * right - left * left)
           + beta * (right * right * right - left * left * left);
}

static void fput_step(double *restrict q, double *restrict p, long n, double h, double a, double b)
{
    if (n == 1) {
        p[0] += h * fput_force(q[0], -q[0], a, b);
    } else {
        p[0] += h * fput_force(q[0], q[1] - q[0], a, b);
        for (long i = 1; i < n - 1; i++)
            p[i] += h * fput_force(q[i] - q[i - 1], q[i + 1] - q[i], a, b);
        p[n - 1] += h * fput_force(q[n - 1] - q[n - 2], -q[n - 1], a, b);
    }
    for (long i = 0; i < n; i++)
        q[i] += h * p[i];
}

void fput(ARGUMENTS)
{
    long n = size[0], every = size[1], saves = every ? steps / every + 1 : 0, row = 0;
    if (every) {
        memcpy(work, q, n * sizeof *q);
        memcpy(work + saves * n, p, n * sizeof *p);
    }
    for (long s = 1; s <= steps; s++) {
        fput_step(q, p, n, h, c[0], c[1]);
        if (every && s % every == 0) {
            row++;
            memcpy(work + row * n, q, n * sizeof *q);
            memcpy(work + (saves + row) * n, p, n * sizeof *p);
        }
    }
}

static double fput_energy(const double *q, const double *p, long n, double a, double b)
{
    double sum = 0;
    for (long i = 0; i < n; i++)
        sum += p[i] * p[i] / 2;
    for (long i = 0; i <= n; i++) {
        double d = (i < n ? q[i] : 0) - (i ? q[i - 1] : 0);
        sum += d * d * (1.0 / 2 + d * (a / 3 + d * b / 4));
    }
    return sum;
}

/* The same, and the largest drift of the energy in work[0]. */
void fput_drift(ARGUMENTS)
{
    long n = size[0];
    double first = fput_energy(q, p, n, c[0], c[1]), most = 0;
    for (long s = 0; s < steps; s++) {
        fput_step(q, p, n, h, c[0], c[1]);
        double drift = fabs(fput_energy(q, p, n, c[0], c[1]) - first);
        most = drift > most ? drift : most;
    }
    work[0] = most;
}

/* The test of convergence of dvi.Picard for one unknown: x its new value, d the size of its last
   correction, x0 the guess, size the scale of the start. The sums are those of all unknowns. */
typedef struct {
    double scale, largest, factor;
    int is_later, converged;
} test;

static inline void is_good(test *t, test *next, double x, double d, double x0, double size,
                           double *last, double *good)
{
    const double eps = 0x1p-52;
    double s = fmax(size, fabs(x)), bound = eps / 16 * s * (*last - d);
    int accurate = (bound > 0x1p-1022) & (d * d <= bound);
    int four = (d >= *last / 2) | (d <= t->factor * fabs(x - x0));
    int at_rest = d <= eps * (four ? 4 : 1) * s;
    int round_off = d <= 64 * eps * s + 4 * eps * t->scale;
    int result = accurate | at_rest | (round_off & (((d >= *last) & t->is_later) | (*good > 0)));
    next->converged &= result;
    next->scale = fmax(next->scale, s);
    next->largest = fmax(next->largest, d);
    *good = result;
    *last = d;
}

/* Before the first iteration, from the largest unknown; and from one iteration to the next. */
static test first_test(const double *x, const double *y, long n, double *last, double *good)
{
    test t = {0, 0, 1, 0, 0};
    for (long i = 0; i < n; i++) {
        t.scale = fmax(t.scale, fmax(fabs(x[i]), fabs(y[i])));
        last[i] = good[i] = 0;
    }
    return t;
}

static test next_test(test next, long iterations)
{
    next.is_later = 1;
    next.factor = ldexp(1, -3 * (int)(iterations < 7 ? iterations : 7));
    return next;
}

/* Gauss-Legendre collocation with two stages for the same chain: size n, iterations. The unknowns
   are the stages' rates, from those at the start; work 6 n. */
static void fput_rates(const double *restrict x, double *restrict f, long n, double a, double b)
{
    for (long i = 0; i < n; i++)
        f[i] = fput_force(x[i] - (i ? x[i - 1] : 0), (i < n - 1 ? x[i + 1] : 0) - x[i], a, b);
}

void fput_gauss(ARGUMENTS)
{
    long n = size[0], iterations = size[1];
    double r = sqrt(3.0) / 6, a[2][2] = {{0.25, 0.25 - r}, {0.25 + r, 0.25}};
    double *f[2] = {work, work + n}, *v[2] = {work + 2 * n, work + 3 * n};
    double *x[2] = {work + 4 * n, work + 5 * n};
    for (long s = 0; s < steps; s++) {
        fput_rates(q, f[0], n, c[0], c[1]);
        memcpy(f[1], f[0], n * sizeof *q);
        memcpy(v[0], p, n * sizeof *q);
        memcpy(v[1], p, n * sizeof *q);
        for (long k = 0; k < iterations; k++) {
            for (int j = 0; j < 2; j++)
                for (long i = 0; i < n; i++)
                    x[j][i] = q[i] + h * (a[j][0] * v[0][i] + a[j][1] * v[1][i]);
            for (int j = 0; j < 2; j++)
                for (long i = 0; i < n; i++)
                    v[j][i] = p[i] + h * (a[j][0] * f[0][i] + a[j][1] * f[1][i]);
            for (int j = 0; j < 2; j++)
                fput_rates(x[j], f[j], n, c[0], c[1]);
        }
        for (long i = 0; i < n; i++) {
            q[i] += h / 2 * (v[0][i] + v[1][i]);
            p[i] += h / 2 * (f[0][i] + f[1][i]);
        }
    }
}

/* A stage from the rates of the iteration before. */
static void tested_stage(test *t, test *next, const double *restrict start,
                         const double *restrict r0, const double *restrict r1, double a, double b,
                         double *restrict x, const double *restrict guess, double *restrict last,
                         double *restrict good, long n)
{
    test now = *t, later = *next;
    for (long i = 0; i < n; i++) {
        double new = start[i] + a * r0[i] + b * r1[i], d = fabs(new - x[i]);
        x[i] = new;
        is_good(&now, &later, new, d, guess[i], fmax(fabs(start[i]), fabs(guess[i])), last + i,
                good + i);
    }
    *next = later;
}

/* The same, until the test of convergence is met for the stages x and v: size n; work 18 n. The
   guess is that of the package: the rates at the start for each stage. */
void fput_gauss_tested(ARGUMENTS)
{
    long n = size[0];
    double r = sqrt(3.0) / 6, a[2][2] = {{0.25, 0.25 - r}, {0.25 + r, 0.25}};
    double *f[2] = {work, work + n}, *v[2] = {work + 2 * n, work + 3 * n};
    double *x[2] = {work + 4 * n, work + 5 * n};
    double *last = work + 6 * n, *good = work + 10 * n, *guess = work + 14 * n;
    for (long s = 0; s < steps; s++) {
        fput_rates(q, f[0], n, c[0], c[1]);
        for (int j = 0; j < 2; j++)
            for (long i = 0; i < n; i++) {
                guess[j * n + i] = x[j][i] = q[i] + h * (a[j][0] + a[j][1]) * p[i];
                guess[(2 + j) * n + i] = v[j][i] = p[i] + h * (a[j][0] + a[j][1]) * f[0][i];
            }
        test t = first_test(work + 2 * n, guess, 4 * n, last, good);
        for (int j = 0; j < 2; j++)
            fput_rates(x[j], f[j], n, c[0], c[1]);
        for (long k = 1; k <= 50 && !t.converged; k++) {
            test next = {0, 0, 0, 0, 1};
            for (int j = 0; j < 2; j++)
                tested_stage(&t, &next, q, v[0], v[1], h * a[j][0], h * a[j][1], x[j],
                             guess + j * n, last + j * n, good + j * n, n);
            for (int j = 0; j < 2; j++)
                tested_stage(&t, &next, p, f[0], f[1], h * a[j][0], h * a[j][1], v[j],
                             guess + (2 + j) * n, last + (2 + j) * n, good + (2 + j) * n, n);
            for (int j = 0; j < 2; j++)
                fput_rates(x[j], f[j], n, c[0], c[1]);
            t = next_test(next, k);
        }
        for (long i = 0; i < n; i++) {
            q[i] += h / 2 * (v[0][i] + v[1][i]);
            p[i] += h / 2 * (f[0][i] + f[1][i]);
        }
    }
}

/* The periodic Toda lattice: size n; work n, the exponentials. */
void toda(ARGUMENTS)
{
    long n = size[0];
    for (long s = 0; s < steps; s++) {
        for (long i = 0; i < n - 1; i++)
            work[i] = exp(q[i] - q[i + 1]);
        work[n - 1] = exp(q[n - 1] - q[0]);
        p[0] += h * (work[n - 1] - work[0]);
        for (long i = 1; i < n; i++)
            p[i] += h * (work[i - 1] - work[i]);
        for (long i = 0; i < n; i++)
            q[i] += h * p[i];
    }
}

/* sum p^2/2 + (q_i+1 - q_i)^2/2 + 1 - cos q_i on a ring: size n. */
void sine_gordon(ARGUMENTS)
{
    long n = size[0];
    for (long s = 0; s < steps; s++) {
        p[0] += h * (q[n - 1] - 2 * q[0] + q[1] - sin(q[0]));
        for (long i = 1; i < n - 1; i++)
            p[i] += h * (q[i - 1] - 2 * q[i] + q[i + 1] - sin(q[i]));
        p[n - 1] += h * (q[n - 2] - 2 * q[n - 1] + q[0] - sin(q[n - 1]));
        for (long i = 0; i < n; i++)
            q[i] += h * p[i];
    }
}

/* sum p^2/2 + sum over bonds (difference)^2/2 + q^2/2 + c q^4/4, periodic: size n (n x n sites). */
void phi4_2d(ARGUMENTS)
{
    long n = size[0];
    for (long s = 0; s < steps; s++) {
        for (long i = 0; i < n; i++) {
            const double *u = q + (i ? i - 1 : n - 1) * n, *d = q + (i < n - 1 ? i + 1 : 0) * n;
            const double *r = q + i * n;
            double *f = p + i * n;
#define FORCE(l, j, m) (u[j] + d[j] + r[l] + r[m] - r[j] * (5 + c[0] * r[j] * r[j]))
            f[0] += h * FORCE(n - 1, 0, 1);
            for (long j = 1; j < n - 1; j++)
                f[j] += h * FORCE(j - 1, j, j + 1);
            f[n - 1] += h * FORCE(n - 2, n - 1, 0);
#undef FORCE
        }
        for (long i = 0; i < n * n; i++)
            q[i] += h * p[i];
    }
}

void phi4_3d(ARGUMENTS)
{
    long n = size[0], m = n * n;
    for (long s = 0; s < steps; s++) {
        for (long k = 0; k < n; k++)
            for (long i = 0; i < n; i++) {
                const double *r = q + k * m + i * n;
                const double *a = q + (k ? k - 1 : n - 1) * m + i * n;
                const double *b = q + (k < n - 1 ? k + 1 : 0) * m + i * n;
                const double *u = q + k * m + (i ? i - 1 : n - 1) * n;
                const double *d = q + k * m + (i < n - 1 ? i + 1 : 0) * n;
                double *f = p + k * m + i * n;
#define FORCE(l, j, g) \
    (a[j] + b[j] + u[j] + d[j] + r[l] + r[g] - r[j] * (7 + c[0] * r[j] * r[j]))
                f[0] += h * FORCE(n - 1, 0, 1);
                for (long j = 1; j < n - 1; j++)
                    f[j] += h * FORCE(j - 1, j, j + 1);
                f[n - 1] += h * FORCE(n - 2, n - 1, 0);
#undef FORCE
            }
        for (long i = 0; i < n * m; i++)
            q[i] += h * p[i];
    }
}

/* n bodies of mass c[1], softening length squared c[0]: size n; work 6 n. Over all pairs, with the
   coordinates as a structure of arrays during the run. */
void n_body(ARGUMENTS)
{
    long n = size[0];
    double *x = work, *y = work + n, *z = work + 2 * n, *a = work + 3 * n, m = c[1];
    for (long i = 0; i < n; i++)
        x[i] = q[3 * i], y[i] = q[3 * i + 1], z[i] = q[3 * i + 2];
    for (long s = 0; s < steps; s++) {
        for (long i = 0; i < n; i++) {
            double ax = 0, ay = 0, az = 0;
            for (long j = 0; j < n; j++) {
                double dx = x[j] - x[i], dy = y[j] - y[i], dz = z[j] - z[i];
                double r2 = dx * dx + dy * dy + dz * dz + c[0], w = 1 / (r2 * sqrt(r2));
                ax += w * dx, ay += w * dy, az += w * dz;
            }
            a[i] = ax, a[n + i] = ay, a[2 * n + i] = az;
        }
        for (long i = 0; i < n; i++) {
            p[3 * i] += h * m * m * a[i], x[i] += h * p[3 * i] / m;
            p[3 * i + 1] += h * m * m * a[n + i], y[i] += h * p[3 * i + 1] / m;
            p[3 * i + 2] += h * m * m * a[2 * n + i], z[i] += h * p[3 * i + 2] / m;
        }
    }
    for (long i = 0; i < n; i++)
        q[3 * i] = x[i], q[3 * i + 1] = y[i], q[3 * i + 2] = z[i];
}

/* The same over half of the pairs: each force on both bodies. */
void n_body_half(ARGUMENTS)
{
    long n = size[0];
    double *x = work, *y = work + n, *z = work + 2 * n, m = c[1];
    double *restrict a = work + 3 * n, *restrict b = work + 4 * n, *restrict d = work + 5 * n;
    for (long i = 0; i < n; i++)
        x[i] = q[3 * i], y[i] = q[3 * i + 1], z[i] = q[3 * i + 2];
    for (long s = 0; s < steps; s++) {
        memset(a, 0, 3 * n * sizeof *a);
        for (long i = 0; i < n; i++) {
            double ax = 0, ay = 0, az = 0;
            for (long j = i + 1; j < n; j++) {
                double dx = x[j] - x[i], dy = y[j] - y[i], dz = z[j] - z[i];
                double r2 = dx * dx + dy * dy + dz * dz + c[0], w = 1 / (r2 * sqrt(r2));
                ax += w * dx, ay += w * dy, az += w * dz;
                a[j] -= w * dx, b[j] -= w * dy, d[j] -= w * dz;
            }
            a[i] += ax, b[i] += ay, d[i] += az;
        }
        for (long i = 0; i < n; i++) {
            p[3 * i] += h * m * m * a[i], x[i] += h * p[3 * i] / m;
            p[3 * i + 1] += h * m * m * b[i], y[i] += h * p[3 * i + 1] / m;
            p[3 * i + 2] += h * m * m * d[i], z[i] += h * p[3 * i + 2] / m;
        }
    }
    for (long i = 0; i < n; i++)
        q[3 * i] = x[i], q[3 * i + 1] = y[i], q[3 * i + 2] = z[i];
}

/* The discrete nonlinear Schroedinger equation on a ring, by fixed-point iteration for p1: size n,
   iterations; c kappa, gamma; work 2 n. */
void nls(ARGUMENTS)
{
    long n = size[0], iterations = size[1];
    double *restrict x = work, *restrict f = work + n;
    for (long s = 0; s < steps; s++) {
        for (long i = 0; i < n; i++) {
            long l = i ? i - 1 : n - 1, r = i < n - 1 ? i + 1 : 0;
            f[i] = p[i] - h * c[0] * (2 * q[i] - q[l] - q[r]);
            x[i] = p[i];
        }
        for (long k = 0; k < iterations; k++)
            for (long i = 0; i < n; i++)
                x[i] = f[i] + h * c[1] / 2 * (q[i] * q[i] + x[i] * x[i]) * q[i];
        for (long i = 0; i < n; i++)
            p[i] = x[i];
        for (long i = 0; i < n; i++)
            q[i] -= h * c[1] / 2 * (q[i] * q[i] + p[i] * p[i]) * p[i];
        for (long i = 0; i < n; i++) {
            long l = i ? i - 1 : n - 1, r = i < n - 1 ? i + 1 : 0;
            q[i] += h * c[0] * (2 * p[i] - p[l] - p[r]);
        }
    }
}

/* The same, until the test of convergence is met: size n; work 5 n. */
void nls_tested(ARGUMENTS)
{
    long n = size[0];
    double *restrict x = work, *restrict f = work + n;
    double *restrict last = work + 2 * n, *restrict good = work + 3 * n;
    for (long s = 0; s < steps; s++) {
        for (long i = 0; i < n; i++) {
            long l = i ? i - 1 : n - 1, r = i < n - 1 ? i + 1 : 0;
            f[i] = p[i] - h * c[0] * (2 * q[i] - q[l] - q[r]);
            x[i] = f[i] + h * c[1] / 2 * (q[i] * q[i] + p[i] * p[i]) * q[i];
            work[4 * n + i] = x[i];
        }
        test t = first_test(p, x, n, last, good);
        for (long k = 1; k <= 50 && !t.converged; k++) {
            test next = {0, 0, 0, 0, 1};
            for (long i = 0; i < n; i++) {
                double x0 = work[4 * n + i], size0 = fmax(fabs(p[i]), fabs(x0));
                double new = f[i] + h * c[1] / 2 * (q[i] * q[i] + x[i] * x[i]) * q[i];
                double d = fabs(new - x[i]);
                x[i] = new;
                is_good(&t, &next, new, d, x0, size0, last + i, good + i);
            }
            t = next_test(next, k);
        }
        for (long i = 0; i < n; i++)
            p[i] = x[i];
        for (long i = 0; i < n; i++)
            q[i] -= h * c[1] / 2 * (q[i] * q[i] + p[i] * p[i]) * p[i];
        for (long i = 0; i < n; i++) {
            long l = i ? i - 1 : n - 1, r = i < n - 1 ? i + 1 : 0;
            q[i] += h * c[0] * (2 * p[i] - p[l] - p[r]);
        }
    }
}

/* sum (1 + A q^2) p^2/2 + B sum q_i q_i+1 p_i p_i+1 + sum (d^2/2 + C d^4/4), fixed ends, by Newton's
   method with Thomas' algorithm: size n, iterations; c A, B, C; work 3 n. */
void band(ARGUMENTS)
{
    long n = size[0], iterations = size[1];
    double *restrict f = work, *restrict up = work + n, *restrict r = work + 2 * n;
    for (long s = 0; s < steps; s++) {
        double *x = work + 3 * n;
        for (long i = 0; i < n; i++) {
            double left = q[i] - (i ? q[i - 1] : 0), right = (i < n - 1 ? q[i + 1] : 0) - q[i];
            f[i] = p[i] + h * (right - left + c[2] * (right * right * right - left * left * left));
            x[i] = p[i];
        }
        for (long k = 0; k < iterations; k++) {
            double u = 0, y = 0;
            for (long i = 0; i < n; i++) {
                double l = i ? q[i - 1] : 0, m = i < n - 1 ? q[i + 1] : 0;
                double w = (i ? l * x[i - 1] : 0) + (i < n - 1 ? m * x[i + 1] : 0);
                double g = x[i] - f[i] + h * x[i] * q[i] * (c[0] * x[i]) + h * c[1] * x[i] * w;
                double pivot = 1 + h * (2 * c[0] * q[i] * x[i] + c[1] * w);
                double low = h * c[1] * x[i] * l, high = h * c[1] * x[i] * m;
                double v = 1 / (pivot - low * u);
                up[i] = u = high * v;
                r[i] = y = (g - low * y) * v;
            }
            y = 0;
            for (long i = n - 1; i >= 0; i--) {
                y = r[i] - up[i] * y;
                x[i] -= y;
            }
        }
        for (long i = 0; i < n; i++)
            p[i] = x[i];
        for (long i = 0; i < n; i++) {
            double w = (i ? q[i - 1] * p[i - 1] : 0) + (i < n - 1 ? q[i + 1] * p[i + 1] : 0);
            r[i] = (1 + c[0] * q[i] * q[i]) * p[i] + c[1] * q[i] * w;
        }
        for (long i = 0; i < n; i++)
            q[i] += h * r[i];
    }
}
