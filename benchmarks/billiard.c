/* Sinai's billiard by steps of size h with located reflections: what jumps are compared with.

The table is |x|, |y| <= 1 outside of the disc of radius R at the origin; mass 1. As in the package
a step is tried first; if a wall is passed in it, the first point on a wall is computed to the last
digit by false position (Illinois, bisection in every third iteration), the momentum is reflected,
and the rest of the step follows, up to 8 times. A disc that is entered and left within one step is
noticed by the tangents of g at the ends. `exact` solves for the time of the next wall in closed
form instead, without steps. Both return the number of reflections; q and p are overwritten. */

#include <float.h>
#include <math.h>

#define WALLS 3

static double wall(int i, double R, double x, double y) {
  if (i == 0) return R * R - x * x - y * y;
  return fabs(i == 1 ? x : y) - 1.0;
}

static double rate(int i, double x, double y, double u, double v) {
  if (i == 0) return -2.0 * (x * u + y * v);
  return i == 1 ? (x < 0 ? -u : u) : (y < 0 ? -v : v);
}

static void reflect(int i, double R, const double *q, double *p) {
  if (i == 1) { p[0] = -p[0]; return; }
  if (i == 2) { p[1] = -p[1]; return; }
  double n[2] = {q[0] / R, q[1] / R}, s = 2.0 * (p[0] * n[0] + p[1] * n[1]);
  p[0] -= s * n[0];
  p[1] -= s * n[1];
}

/* The largest g of the candidates at the fraction t of a flight of duration h. */
static double largest(const int *is_candidate, const double *top, const double *at_top, double R,
                      const double *q, const double *p, double h, double t, int *which) {
  double x = q[0] + t * h * p[0], y = q[1] + t * h * p[1], best = -INFINITY;
  for (int i = 0; i < WALLS; i++) {
    if (!is_candidate[i]) continue;
    double g = t > top[i] ? at_top[i] : wall(i, R, x, y);
    if (g > best) { best = g; *which = i; }
  }
  return best;
}

long steps(double *q, double *p, double R, double h, long count) {
  long reflections = 0;
  double before[WALLS];
  for (int i = 0; i < WALLS; i++) before[i] = wall(i, R, q[0], q[1]);
  for (long k = 0; k < count; k++) {
    double left = h;
    int last = -1;
    for (int round = 0; round < 9; round++) {
      double end[2] = {q[0] + left * p[0], q[1] + left * p[1]};
      double after[WALLS], top[WALLS], at_top[WALLS];
      int is_candidate[WALLS], any = 0;
      for (int i = 0; i < WALLS; i++) {
        after[i] = at_top[i] = wall(i, R, end[0], end[1]);
        top[i] = 1.0;
        is_candidate[i] = i != last && before[i] < 0 && after[i] >= 0;
        if (i != last && before[i] < 0 && after[i] < 0) {
          double a = before[i], A = left * rate(i, q[0], q[1], p[0], p[1]);
          double b = after[i], B = left * rate(i, end[0], end[1], p[0], p[1]), lo = 0, hi = 1;
          for (int n = 0; n < 50 && A > 0 && B < 0 && a < 0 && b < 0; n++) {
            double t = (b - B - a) / (A - B);
            if (!(a + A * t >= 0)) break;
            double w = hi - lo, m = lo + t * w;
            double x = q[0] + m * left * p[0], y = q[1] + m * left * p[1];
            double g = wall(i, R, x, y), slope = left * rate(i, x, y, p[0], p[1]);
            if (g >= 0) { top[i] = m; at_top[i] = g; is_candidate[i] = 1; break; }
            if (slope <= 0) { hi = m; b = g; B = slope; } else { lo = m; a = g; A = slope; }
            w = hi - lo;
            A = A > 0 ? w * left * rate(i, q[0] + lo * left * p[0], q[1] + lo * left * p[1], p[0], p[1]) : A;
            B = B < 0 ? w * left * rate(i, q[0] + hi * left * p[0], q[1] + hi * left * p[1], p[0], p[1]) : B;
          }
        }
        any |= is_candidate[i];
      }
      if (!any) {
        q[0] = end[0];
        q[1] = end[1];
        for (int i = 0; i < WALLS; i++) before[i] = after[i];
        break;
      }
      int which = 0;
      double a = 0, b = 1;
      double fa = largest(is_candidate, top, at_top, R, q, p, left, 0, &which);
      double fb = largest(is_candidate, top, at_top, R, q, p, left, 1, &which);
      for (int n = 0; n < 100 && fabs(b - a) > 2 * DBL_EPSILON * fmax(fabs(a), fabs(b)) && fb != 0; n++) {
        double c = b - fb * (b - a) / (fb - fa);
        if (!isfinite(c) || n % 3 == 2) c = (a + b) / 2;
        double fc = largest(is_candidate, top, at_top, R, q, p, left, c, &which);
        if ((fc > 0) != (fb > 0) || fc == 0) { a = b; fa = fb; } else fa /= 2;
        b = c;
        fb = fc;
      }
      largest(is_candidate, top, at_top, R, q, p, left, b, &which);
      q[0] += b * left * p[0];
      q[1] += b * left * p[1];
      reflect(which, R, q, p);
      left *= 1 - b;
      last = which;
      reflections++;
      for (int i = 0; i < WALLS; i++) before[i] = wall(i, R, q[0], q[1]);
    }
  }
  return reflections;
}

long exact(double *q, double *p, double R, double duration) {
  long reflections = 0;
  for (double left = duration;;) {
    double tx = ((p[0] > 0 ? 1 : -1) - q[0]) / p[0], ty = ((p[1] > 0 ? 1 : -1) - q[1]) / p[1];
    double t = tx < ty ? tx : ty;
    int which = tx < ty ? 1 : 2;
    double b = q[0] * p[0] + q[1] * p[1], v = p[0] * p[0] + p[1] * p[1];
    double d = b * b - v * (q[0] * q[0] + q[1] * q[1] - R * R);
    if (b < 0 && d > 0) {
      double s = (-b - sqrt(d)) / v;
      if (s > 1e-12 && s < t) { t = s; which = 0; }
    }
    if (t > left) t = left, which = -1;
    q[0] += t * p[0];
    q[1] += t * p[1];
    left -= t;
    if (which < 0) return reflections;
    reflect(which, R, q, p);
    reflections++;
  }
}
