"""Bodies that attract one another, by Taylor series in arithmetic of many digits (python-flint).

The order is the number of digits, and the step such that the last terms have the size of the last
digit. It shares no code with the package. Differences between 24 and 32 digits: 2.5e-9 for the
Pythagorean problem at t = 60, which magnifies errors by a factor of 1e13.
"""

import numpy as np
from flint import arb, arb_series, ctx


def taylor(problem, times, digits=24):
    """Positions of the bodies of a planar problem at the times, shape (times, bodies, 2)."""
    ctx.prec, order = int(3.33 * digits) + 20, digits
    masses = [arb(m) for m in problem.args["masses"]]
    q = [[arb(x) for x in row] for row in problem.q0]
    v = [[arb(x) / m for x in row] for row, m in zip(problem.p0, masses, strict=True)]
    pairs = [(i, j) for i in range(len(masses)) for j in range(i)]
    t, found = arb(0), []

    def series(q, v):
        """Series of the positions: each pass through Newton's law gives two more coefficients."""
        known = [[[q[i][c], v[i][c]] for c in (0, 1)] for i in range(len(masses))]
        while len(known[0][0]) <= order:
            ctx.cap = len(known[0][0])
            x = [[arb_series(a) for a in row] for row in known]
            sums = [[arb_series([0]) for _ in row] for row in known]
            for i, j in pairs:
                d = [a - b for a, b in zip(x[j], x[i], strict=True)]
                square = d[0] * d[0] + d[1] * d[1]
                weight = 1 / (square * square.sqrt())
                for c in (0, 1):
                    sums[i][c] += masses[j] * d[c] * weight
                    sums[j][c] -= masses[i] * d[c] * weight
            for row, total in zip(known, sums, strict=True):
                for a, force in zip(row, total, strict=True):
                    new = [force[k] / ((k + 1) * (k + 2)) for k in range(len(a))]
                    a[2:] = new[: order - 1]
        return known

    while len(found) < len(times):
        known = series(q, v)
        # The last terms are 10^-digits of unit length: the radius of convergence estimated twice.
        rate = max(
            float(abs(a[k].mid())) ** (1 / k)
            for row in known
            for a in row
            for k in (order - 1, order)
        )
        h, left = arb(10.0 ** (-digits / order) / rate), arb(times[len(found)]) - t
        is_end = float(h - left) >= 0
        h = (left if is_end else h).mid()

        def at(a, derivative, h=h):
            total = arb(0)
            for k in range(order, derivative - 1, -1):
                total = total * h + (k * a[k] if derivative else a[k])
            return total.mid()

        q, v = ([[at(a, d) for a in row] for row in known] for d in (0, 1))
        t = (t + h).mid()
        if is_end:
            t = arb(times[len(found)])
            found.append([[float(x) for x in row] for row in q])
    return np.array(found)
