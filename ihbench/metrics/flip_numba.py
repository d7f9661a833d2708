"""The inner loops of FLIP in float64, with numba: opponent channels, separable filters, difference of two colours.

Columns are taken in strips, so that a ring of as many rows as a filter has taps fits into the second-level cache with
all seven horizontally filtered channels of both images. Each output row is their vertical sum and goes straight into
the score: nothing of the image's size is written. Roots, powers, logarithms and exponentials are polynomials without
a branch, so that every loop over a row becomes vector instructions; they are good to a few units in the last digit.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

GROUP = 7  # taps summed in one sweep over a row; weights are filled up with zeros to a multiple of it
PAIRS = 3  # as many for the derivatives, which take a pair of pixels at a time
STRIP = 192  # columns worked on at a time, at most: 450 kB of filtered rows
STRIDE = STRIP + 8  # an odd number of cache lines, so that rows do not evict each other
Y, CX, CZ_1, CZ_2, GAUSS, SLOPE, CURVE = range(7)  # what an image has in the ring; the first five are blurs
CHANNEL_OF = (0, 1, 2, 2, 0, 0, 0)  # of which channel they are
EDGE_X, EDGE_Y, POINT_X, POINT_Y = range(3, 7)  # what follows Y, Cx, Cz in a row filtered both ways
BLURRED_INTO = (Y, CX, CZ_1, CZ_1, -1, EDGE_X, POINT_X)  # where a vertical blur takes them; GAUSS is derived instead

f64 = np.float64
# Offsets are unsigned, so that numba leaves out its test for negative indices, which hides that accesses are
# consecutive.
u64 = np.uint64

# the bits of a float64, and how whole numbers are moved in and out of them
FRACTION, HALF_WORD, EXPONENT_BIAS = u64(52), u64(32), u64(1023)
THIRD = u64(0x55555556)  # 2^32 / 3
INVERSE_CUBE_ROOT = u64(0x553EF0FF289DD796)  # a first guess from the bits alone, to 4 %
TWO_52, BITS_OF_TWO_52 = f64(2.0**52), u64(0x4330000000000000)
ROUND = f64(1.5 * 2.0**52)  # adding it rounds to a whole number, which then stands in the lowest bits
BITS_OF_ROOT_HALF = f64(math.sqrt(0.5)).view(u64)
LN_2, LOG2_E = math.log(2), math.log2(math.e)


def whole_groups(
    blur: NDArray[np.float64],  # [4, n]
    gauss: NDArray[np.float64],  # [m], m <= n
    slope: NDArray[np.float64],  # [r]
    curve: NDArray[np.float64],  # [r]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Weights as `flip_rows` takes them: blurs and the Gaussian [5, N], slope and curve [R], filled up with zeros."""
    taps, pairs = blur.shape[1], -(-len(slope) // PAIRS) * PAIRS
    blurs = np.zeros((5, -(-taps // GROUP) * GROUP))
    blurs[:4, :taps] = blur
    margin = (taps - len(gauss)) // 2
    blurs[4, margin : taps - margin] = gauss
    return blurs, np.pad(slope, (0, pairs - len(slope))), np.pad(curve, (0, pairs - len(curve)))


# ----------------------------------------------------------------------------------------------------
# Elementary functions


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")  # a test for zero would be a branch
def _log(x):
    """The natural logarithm of a normal positive number: 2 artanh of (m - 1) / (m + 1), m in [√½, √2)."""
    bits = f64(x).view(u64)
    exponent = u64(u64(bits - BITS_OF_ROOT_HALF + (EXPONENT_BIAS << FRACTION)) >> FRACTION)
    mantissa = f64(u64(bits - (exponent << FRACTION) + (EXPONENT_BIAS << FRACTION)).view(f64))
    count = f64(u64(exponent | BITS_OF_TWO_52).view(f64)) - (TWO_52 + 1023.0)
    s = (mantissa - 1.0) / (mantissa + 1.0)
    q = s * s
    p = 1 / 21 + q * (1 / 23)
    p = 1 / 17 + q * (1 / 19 + q * p)
    p = 1 / 13 + q * (1 / 15 + q * p)
    p = 1 / 9 + q * (1 / 11 + q * p)
    p = 1 / 5 + q * (1 / 7 + q * p)
    p = q * (1 / 3 + q * p)
    return count * LN_2 + 2.0 * (s + s * p)


@njit(cache=True, nogil=True, fastmath={"contract"})
def _exp(x):
    """e^x for x in [-700, 700]: the Taylor polynomial of what is left of a power of 2."""
    rounded = x * LOG2_E + ROUND
    scale = f64(u64((f64(rounded).view(u64) + EXPONENT_BIAS) << FRACTION).view(f64))
    r = x - (rounded - ROUND) * LN_2
    p = 1 / 479001600 + r * (1 / 6227020800)
    p = 1 / 3628800 + r * (1 / 39916800 + r * p)
    p = 1 / 40320 + r * (1 / 362880 + r * p)
    p = 1 / 720 + r * (1 / 5040 + r * p)
    p = 1 / 24 + r * (1 / 120 + r * p)
    p = 1 / 2 + r * (1 / 6 + r * p)
    return scale * (1.0 + (r + r * r * p))


@njit(cache=True, nogil=True, fastmath={"contract"})
def _lightness(t):
    """CIELAB's f for t in [0, 1]: the cube root, below (6/29)³ a line.

    y = t^(-1/3) from its bits, then twice with the first terms of (1 - h)^(-1/3), h = 1 - t y³: 4 %, 1e-4, 1e-16.
    """
    high = u64((f64(t).view(u64) >> HALF_WORD) * THIRD) >> HALF_WORD
    y = f64(u64(INVERSE_CUBE_ROOT - (high << HALF_WORD)).view(f64))
    h = 1.0 - t * y * y * y
    y += y * h * (1 / 3 + h * (2 / 9 + h * (14 / 81)))
    h = 1.0 - t * y * y * y
    y += y * h * (1 / 3 + h * (2 / 9 + h * (14 / 81)))
    line = t * (841 / 108) + 4 / 29
    return t * y * y if t > 216 / 24389 else line


# ----------------------------------------------------------------------------------------------------
# Opponent channels


@njit(cache=True, nogil=True, fastmath={"contract"})
def _opponent_row(linear, matrix, channels, y):
    """Y, X - Y, Y - Z of a row of linear RGB [3, w] into channels [3, h, w]."""
    a, b, c = matrix[0, 0], matrix[0, 1], matrix[0, 2]
    d, e, f = matrix[1, 0], matrix[1, 1], matrix[1, 2]
    g, h, i = matrix[2, 0], matrix[2, 1], matrix[2, 2]
    for x in range(u64(linear.shape[1])):
        r, s, t = linear[0, x], linear[1, x], linear[2, x]
        Y = d * r + e * s + f * t
        channels[0, y, x] = Y
        channels[1, y, x] = a * r + b * s + c * t - Y
        channels[2, y, x] = Y - (g * r + h * s + i * t)


@njit(cache=True, nogil=True)
def opponent_of_bytes(image, table, inside, paint, matrix, channels):
    """Y, Cx, Cz of an image [h, w, 3] uint8 into channels [3, h, w].

    table [256]: linear RGB of every value
    inside [h, w] bool: the image is painted with linear RGB paint [3] outside; [0, 0] paints nothing
    matrix [3, 3]: linear RGB -> XYZ over white
    """
    height, width = image.shape[:2]
    every = inside.size == 0
    linear = np.empty((3, width))
    for y in range(u64(height)):
        for x in range(u64(width)):
            if every or inside[y, x]:
                for c in range(u64(3)):
                    linear[c, x] = table[image[y, x, c]]
            else:
                for c in range(u64(3)):
                    linear[c, x] = paint[c]
        _opponent_row(linear, matrix, channels, y)


@njit(cache=True, nogil=True, fastmath={"contract"})
def _linear_row(srgb, linear):
    """sRGB [3, w], clipped to [0, 1], to linear RGB (IEC 61966-2-1)."""
    for c in range(u64(3)):
        for x in range(u64(srgb.shape[1])):
            v = srgb[c, x]
            v = v if v > 0.0 else 0.0
            v = v if v < 1.0 else 1.0
            power = _exp(2.4 * _log((v + 0.055) * (1 / 1.055)))
            linear[c, x] = power if v > 0.04045 else v * (1 / 12.92)


@njit(cache=True, nogil=True)
def opponent_of_floats(image, inside, paint, matrix, channels):
    """As `opponent_of_bytes` for floats, clipped to [0, 1]. Whether all inside is finite; what is not counts as 0."""
    height, width = image.shape[:2]
    every = inside.size == 0
    srgb, linear = np.zeros((3, width)), np.empty((3, width))
    finite = True
    for y in range(u64(height)):
        for x in range(u64(width)):
            for c in range(u64(3)):
                v = f64(image[y, x, c])
                if math.isfinite(v):
                    srgb[c, x] = v
                else:
                    srgb[c, x] = 0.0
                    finite &= not (every or inside[y, x])
        _linear_row(srgb, linear)
        if not every:
            for x in range(u64(width)):
                if not inside[y, x]:
                    for c in range(u64(3)):
                        linear[c, x] = paint[c]
        _opponent_row(linear, matrix, channels, y)
    return finite


# ----------------------------------------------------------------------------------------------------
# Filters


@njit(cache=True, nogil=True)
def _fill_line(row, start, count, line):
    """line[x] = row[start + x], continued by the row's ends."""
    last = len(row) - 1
    begin, end = min(max(-start, 0), count), max(min(last + 1 - start, count), 0)
    for x in range(begin):
        line[x] = row[0]
    shift = u64(start + begin)
    for x in range(u64(end - begin)):
        line[u64(begin) + x] = row[shift + x]
    for x in range(max(end, begin), count):
        line[x] = row[last]


@njit(cache=True, nogil=True)
def _clear(row, first, last):
    for x in range(u64(first), u64(last)):
        row[x] = 0.0


@njit(cache=True, nogil=True)
def _group(weights, k):
    return (
        weights[k], weights[k + 1], weights[k + 2], weights[k + 3], weights[k + 4], weights[k + 5], weights[k + 6]
    )  # fmt: skip


@njit(cache=True, nogil=True)  # not contracted: a flat patch must come out the same in every column and row
def _blur_row(line, shift, weights, first, last, out):
    """Add to out[x] the sum over k of weights[k] line[x + k + shift] for first <= x < last."""
    for k in range(0, len(weights), GROUP):
        w0, w1, w2, w3, w4, w5, w6 = _group(weights, k)
        a = u64(k + shift)
        b, c, d, e, f, g = a + u64(1), a + u64(2), a + u64(3), a + u64(4), a + u64(5), a + u64(6)
        for x in range(u64(first), u64(last)):
            q = (w0 * line[x + a] + w1 * line[x + b]) + (w2 * line[x + c] + w3 * line[x + d])
            out[x] += q + (w4 * line[x + e] + w5 * line[x + f] + w6 * line[x + g])


@njit(cache=True, nogil=True, fastmath={"contract"})
def _blur_column(ring, at, weights, first, last, out):
    """Add to out[x] the sum over k of weights[k] ring[at[k], x] for first <= x < last."""
    for k in range(0, len(weights), GROUP):
        w0, w1, w2, w3, w4, w5, w6 = _group(weights, k)
        a, b, c, d = ring[at[k]], ring[at[k + 1]], ring[at[k + 2]], ring[at[k + 3]]
        e, f, g = ring[at[k + 4]], ring[at[k + 5]], ring[at[k + 6]]
        for x in range(u64(first), u64(last)):
            q = (w0 * a[x] + w1 * b[x]) + (w2 * c[x] + w3 * d[x])
            out[x] += q + (w4 * e[x] + w5 * f[x] + w6 * g[x])


@njit(cache=True, nogil=True, fastmath={"contract"})
def _derive(middle, left, right, slope, curve, first, last, slopes, curves):
    """Add slope (right - left) and curve (left + right - 2 middle) of PAIRS pairs of rows to `slopes` and `curves`.

    In two loops: with more arrays LLVM does not check whether they overlap, and gives up on vector instructions.
    """
    a0, a1, a2 = left
    b0, b1, b2 = right
    w0, w1, w2 = slope
    for x in range(u64(first), u64(last)):
        slopes[x] += w0 * (b0[x] - a0[x]) + w1 * (b1[x] - a1[x]) + w2 * (b2[x] - a2[x])
    w0, w1, w2 = curve
    for x in range(u64(first), u64(last)):
        m = 2.0 * middle[x]
        curves[x] += w0 * (a0[x] + b0[x] - m) + w1 * (a1[x] + b1[x] - m) + w2 * (a2[x] + b2[x] - m)


@njit(cache=True, nogil=True)
def _filter_row(line, pad, radius, blur, slope, curve, channel, first, last, ring, slot):
    """One channel of a row through its horizontal filters into ring [7, taps, STRIDE] for first <= x < last.

    line: line[pad + x] is column x, with `pad` more on both sides
    """
    for q in range(7):
        if CHANNEL_OF[q] == channel:
            _clear(ring[q, slot], first, last)
            if q <= GAUSS:
                _blur_row(line, pad - radius, blur[q], first, last, ring[q, slot])
    if channel == 0:
        for k in range(0, len(slope), PAIRS):
            left = line[pad - k - 1 :], line[pad - k - 2 :], line[pad - k - 3 :]
            right = line[pad + k + 1 :], line[pad + k + 2 :], line[pad + k + 3 :]
            s, c = (slope[k], slope[k + 1], slope[k + 2]), (curve[k], curve[k + 1], curve[k + 2])
            _derive(line[pad:], left, right, s, c, first, last, ring[SLOPE, slot], ring[CURVE, slot])


@njit(cache=True, nogil=True)
def _filter_columns(ring, at, middle, radius, blur, slope, curve, first, last, out):
    """The vertical filters of one image: ring [7, taps, STRIDE] -> out [7, STRIDE] for first <= x < last.

    at: at[middle + k] is the slot of the row k below
    """
    for q in range(7):
        _clear(out[q], first, last)
    for q in range(7):
        if q != GAUSS:
            _blur_column(ring[q], at[middle - radius :], blur[min(q, GAUSS)], first, last, out[BLURRED_INTO[q]])
    rows = ring[GAUSS]
    for k in range(0, len(slope), PAIRS):
        left = rows[at[middle - k - 1]], rows[at[middle - k - 2]], rows[at[middle - k - 3]]
        right = rows[at[middle + k + 1]], rows[at[middle + k + 2]], rows[at[middle + k + 3]]
        s, c = (slope[k], slope[k + 1], slope[k + 2]), (curve[k], curve[k + 1], curve[k + 2])
        _derive(rows[at[middle]], left, right, s, c, first, last, out[EDGE_Y], out[POINT_Y])


# ----------------------------------------------------------------------------------------------------
# The score


@njit(cache=True, nogil=True, fastmath={"contract"})
def _lab_row(rows, to_xyz, to_rgb, first, last):
    """Y, Cx, Cz in rows [7, STRIDE] become L, a L / 100, b L / 100 of the colour clipped to the RGB cube."""
    a, b, c = to_xyz[0, 0], to_xyz[0, 1], to_xyz[0, 2]
    d, e, f = to_xyz[1, 0], to_xyz[1, 1], to_xyz[1, 2]
    g, h, i = to_xyz[2, 0], to_xyz[2, 1], to_xyz[2, 2]
    j, k, l = to_rgb[0, 0], to_rgb[0, 1], to_rgb[0, 2]
    m, n, o = to_rgb[1, 0], to_rgb[1, 1], to_rgb[1, 2]
    p, q, r = to_rgb[2, 0], to_rgb[2, 1], to_rgb[2, 2]
    row_y, row_x, row_z = rows[Y], rows[CX], rows[CZ_1]
    for x in range(u64(first), u64(last)):
        Yc = row_y[x]
        X, Z = Yc + row_x[x], Yc - row_z[x]
        red, green, blue = j * X + k * Yc + l * Z, m * X + n * Yc + o * Z, p * X + q * Yc + r * Z
        red = red if red > 0.0 else 0.0
        green = green if green > 0.0 else 0.0
        blue = blue if blue > 0.0 else 0.0
        red = red if red < 1.0 else 1.0
        green = green if green < 1.0 else 1.0
        blue = blue if blue < 1.0 else 1.0
        fx = _lightness(a * red + b * green + c * blue)
        fy = _lightness(d * red + e * green + f * blue)
        fz = _lightness(g * red + h * green + i * blue)
        lightness = 116.0 * fy - 16.0
        row_y[x] = lightness
        row_x[x] = 5.0 * lightness * (fx - fy)
        row_z[x] = 2.0 * lightness * (fy - fz)


# Each of these loops touches few arrays, as those of `_derive` do.


@njit(cache=True, nogil=True, fastmath={"contract"})
def _magnitude_row(a, b, first, last):
    """a becomes √(a² + b²)."""
    for x in range(u64(first), u64(last)):
        a[x] = math.sqrt(a[x] * a[x] + b[x] * b[x])


@njit(cache=True, nogil=True, fastmath={"contract"})
def _hyab_row(L_p, a_p, b_p, L_t, a_t, b_t, first, last, out):
    for x in range(u64(first), u64(last)):
        a, b = a_p[x] - a_t[x], b_p[x] - b_t[x]
        out[x] = abs(L_p[x] - L_t[x]) + math.sqrt(a * a + b * b)


@njit(cache=True, nogil=True, fastmath={"contract"})
def _feature_row(edge_p, edge_t, point_p, point_t, first, last):
    """edge_p becomes the feature difference."""
    for x in range(u64(first), u64(last)):
        edge, point = abs(edge_p[x] - edge_t[x]), abs(point_p[x] - point_t[x])
        edge_p[x] = math.sqrt((edge if edge > point else point) * math.sqrt(0.5))


@njit(cache=True, nogil=True, fastmath={"contract"})
def _combine_row(feature, exponent, knee_at, knee, largest, first, last, out):
    """From HyAB distances in `out` and feature differences to FLIP in `out`."""
    tiny = 1e-300  # stands in for 0 in logarithms
    at, low, high = knee_at * largest, knee / (knee_at * largest), (1.0 - knee) / ((1.0 - knee_at) * largest)
    for x in range(u64(first), u64(last)):
        distance = out[x]
        color = _exp(exponent * _log(distance if distance > tiny else tiny))
        below, above = color * low, knee + (color - at) * high
        color = below if color < at else above
        value = _exp((1.0 - feature[x]) * _log(color if color > tiny else tiny))
        out[x] = value if distance > tiny else 0.0


@njit(cache=True, nogil=True)
def _flip_row(pred, truth, exponent, knee_at, knee, largest, first, last, out):
    """FLIP from both images' rows [7, STRIDE] of Lab and features, which it overwrites, for first <= x < last."""
    for rows in (pred, truth):
        _magnitude_row(rows[EDGE_X], rows[EDGE_Y], first, last)
        _magnitude_row(rows[POINT_X], rows[POINT_Y], first, last)
    _feature_row(pred[EDGE_X], truth[EDGE_X], pred[POINT_X], truth[POINT_X], first, last)
    _hyab_row(pred[Y], pred[CX], pred[CZ_1], truth[Y], truth[CX], truth[CZ_1], first, last, out)
    _combine_row(pred[EDGE_X], exponent, knee_at, knee, largest, first, last, out)


@njit(cache=True, nogil=True, fastmath={"contract"})
def _sum(values, counts, first, last):
    """The sum of counts times values. Four sums side by side, in an order of our own: see `splat_numba._FAST`."""
    a = b = c = d = 0.0
    whole = first + (last - first) // 4 * 4
    for x in range(u64(first), u64(whole), u64(4)):
        a += counts[x] * values[x]
        b += counts[x + u64(1)] * values[x + u64(1)]
        c += counts[x + u64(2)] * values[x + u64(2)]
        d += counts[x + u64(3)] * values[x + u64(3)]
    for x in range(u64(whole), u64(last)):
        a += counts[x] * values[x]
    return (a + b) + (c + d)


@njit(cache=True, nogil=True)
def _spans(differs, counted, top, bottom, radius):
    """First [h] and one past the last [h] column of every row that need work; first >= last where none does."""
    height, width = differs.shape
    first, last = np.zeros(height, np.int64), np.zeros(height, np.int64)
    first[:] = width
    for y in range(height):
        begin, end = 0, width
        while begin < end and not differs[y, begin]:
            begin += 1
        while end > begin and not differs[y, end - 1]:
            end -= 1
        if begin < end:
            for i in range(max(y - radius, top), min(y + radius + 1, bottom)):
                first[i] = min(first[i], max(begin - radius, 0))
                last[i] = max(last[i], min(end + radius, width))
    if counted.size:
        for y in range(top, bottom):
            while first[y] < last[y] and not counted[y, first[y]]:
                first[y] += 1
            while first[y] < last[y] and not counted[y, last[y] - 1]:
                last[y] -= 1
    return first, last


@njit(cache=True, nogil=True)
def flip_rows(pred, truth, differs, counted, top, bottom, radius, blur, slope, curve, to_xyz, to_rgb, remap, keep):
    """The sum of FLIP over the counted pixels of some rows.

    pred, truth [3, h, w] float64: Y, Cx, Cz; filters continue them by their outermost pixels
    differs [h, w] bool: where they differ
    counted [h, w] bool: the pixels that count, [0, 0] for all
    top, bottom: the rows, top <= y < bottom
    radius: px, of the widest filter
    blur [5, n], slope [r], curve [r]: weights from `whole_groups`
    to_xyz, to_rgb [3, 3]: linear RGB -> XYZ over white and back
    remap [4]: exponent of the colour difference, KNEE_AT, KNEE, the largest colour difference
    keep [h, w]: takes FLIP itself where there is work, [0, 0] for nowhere
    """
    height = len(differs)
    exponent, knee_at, knee, largest = remap
    # filters that are filled up with zeros look further than they reach
    pad = max(len(slope), blur.shape[1])
    taps = 2 * radius + 1
    ring = np.zeros((2, 7, taps, STRIDE))
    rows = np.zeros((2, 7, STRIDE))
    line = np.zeros(STRIP + 2 * pad)
    at = np.zeros(2 * pad + 1, np.int64)
    values, counts = np.zeros(STRIDE), np.ones(STRIDE)
    first, last = np.zeros(height, np.int64), np.zeros(height, np.int64)
    all_first, all_last = _spans(differs, counted, top, bottom, radius)
    total = 0.0
    begin, end = differs.shape[1], 0
    for y in range(top, bottom):
        if all_first[y] < all_last[y]:
            begin, end = min(begin, all_first[y]), max(end, all_last[y])
    strips = max(-(-(end - begin) // STRIP), 0)
    for strip in range(strips):  # of equal widths
        left, right = begin + (end - begin) * strip // strips, begin + (end - begin) * (strip + 1) // strips
        for y in range(top, bottom):
            first[y], last[y] = max(all_first[y] - left, 0), min(all_last[y], right) - left
        filtered = 0  # rows that are in the ring, or were, or are not needed
        for y in range(top, bottom):
            if first[y] >= last[y]:
                continue
            for i in range(max(filtered, y - radius), min(y + radius + 1, height)):
                # the columns that any row within reach wants of this one
                a, b = first[y], last[y]
                for j in range(max(i - radius, top), min(i + radius + 1, bottom)):
                    if first[j] < last[j]:
                        a, b = min(a, first[j]), max(b, last[j])
                for image in range(2):
                    planes = pred if image == 0 else truth
                    for channel in range(3):
                        _fill_line(planes[channel, i], left + a - pad, b - a + 2 * pad, line[a:])
                        _filter_row(line, pad, radius, blur, slope, curve, channel, a, b, ring[image], i % taps)
            filtered = min(y + radius + 1, height)
            for k in range(-pad, pad + 1):
                at[pad + k] = min(max(y + min(max(k, -radius), radius), 0), height - 1) % taps
            for image in range(2):
                _filter_columns(ring[image], at, pad, radius, blur, slope, curve, first[y], last[y], rows[image])
                _lab_row(rows[image], to_xyz, to_rgb, first[y], last[y])
            _flip_row(rows[0], rows[1], exponent, knee_at, knee, largest, first[y], last[y], values)
            if counted.size:
                row, shift = counted[y], u64(left)
                for x in range(u64(first[y]), u64(last[y])):
                    counts[x] = 1.0 if row[shift + x] else 0.0
            total += _sum(values, counts, first[y], last[y])
            if keep.size:
                for x in range(first[y], last[y]):
                    keep[y, left + x] = values[x]
    return total
