/* MEGNO of Hénon and Heiles' system by leapfrog with its variational equations, lane beside lane. */

#include <math.h>
#include <stddef.h>

enum { BLOCK = 64 };

/* q, p, w: (2, lanes), (2, lanes), (4, lanes); megno: (lanes,). lanes is a multiple of BLOCK. */
void henon_megno(const double *q, const double *p, const double *first, double *megno, ptrdiff_t lanes,
                 ptrdiff_t steps, double h) {
    for (ptrdiff_t b = 0; b < lanes; b += BLOCK) {
        double x[BLOCK], y[BLOCK], u[BLOCK], v[BLOCK], dx[BLOCK], dy[BLOCK], du[BLOCK], dv[BLOCK];
        double sum[BLOCK], area[BLOCK], before[BLOCK];
        for (int i = 0; i < BLOCK; i++) {
            x[i] = q[b + i], y[i] = q[lanes + b + i], u[i] = p[b + i], v[i] = p[lanes + b + i];
            dx[i] = first[0], dy[i] = first[1], du[i] = first[2], dv[i] = first[3];
            sum[i] = area[i] = before[i] = 0;
        }
        double t = 0;
        for (ptrdiff_t k = 0; k < steps; k++) {
            double middle = t + h / 2, end = t + h, inverse = 1 / end;
            for (int i = 0; i < BLOCK; i++) {
                /* half a kick, a drift, half a kick, of the state and of the deviation */
                double r = h / 2;
                double du1 = du[i] - r * ((1 + 2 * y[i]) * dx[i] + 2 * x[i] * dy[i]);
                double dv1 = dv[i] - r * (2 * x[i] * dx[i] + (1 - 2 * y[i]) * dy[i]);
                double u1 = u[i] - r * (x[i] + 2 * x[i] * y[i]);
                double v1 = v[i] - r * (y[i] + x[i] * x[i] - y[i] * y[i]);
                double x1 = x[i] + h * u1, y1 = y[i] + h * v1;
                double dx1 = dx[i] + h * du1, dy1 = dy[i] + h * dv1;
                du1 -= r * ((1 + 2 * y1) * dx1 + 2 * x1 * dy1);
                dv1 -= r * (2 * x1 * dx1 + (1 - 2 * y1) * dy1);
                u[i] = u1 - r * (x1 + 2 * x1 * y1);
                v[i] = v1 - r * (y1 + x1 * x1 - y1 * y1);
                x[i] = x1, y[i] = y1;
                double square = dx1 * dx1 + dy1 * dy1 + du1 * du1 + dv1 * dv1;
                double shrink = 1 / sqrt(square);
                dx[i] = dx1 * shrink, dy[i] = dy1 * shrink, du[i] = du1 * shrink, dv[i] = dv1 * shrink;
                sum[i] += log(square) * middle;
                double now = sum[i] * inverse;
                area[i] += h * (before[i] + now) / 2;
                before[i] = now;
            }
            t = end;
        }
        for (int i = 0; i < BLOCK; i++) megno[b + i] = area[i] / t;
    }
}
