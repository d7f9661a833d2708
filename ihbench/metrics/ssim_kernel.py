"""The inner loop of SSIM: separable window sums of s = x + y and d = x - y, in float64, with numba.

A ring of `taps` rows holds the horizontally filtered s, d, s² and d²; each output row is their vertical sum and goes
straight into the score, so nothing of the image's size is written and all of it stays in the second-level cache.
Channels lie interleaved: a horizontal tap is an offset of C values, and every loop runs over consecutive numbers.
"""

from __future__ import annotations

import numpy as np
from numba import njit

MIRROR, REFLECT, ZERO = 0, 1, 2  # d c b a | a b c d;  d c b | a b c d;  0 0 0 | a b c d
GROUP = 6  # taps summed in one sweep over a row; the weights are filled up with zeros to a multiple of it

# Offsets are unsigned, so that numba leaves out its test for negative indices, which hides that accesses are
# consecutive.
u64 = np.uint64


@njit(cache=True, nogil=True)
def _inside(index, length, border):
    """The row or column that an index falls on; -1 for one that holds zeros."""
    if 0 <= index < length:
        return index
    if border == ZERO:
        return -1
    if border == MIRROR:
        index %= 2 * length
        return index if index < length else 2 * length - 1 - index
    if length == 1:
        return 0
    index %= 2 * length - 2
    return index if index < length else 2 * length - 2 - index


@njit(cache=True, nogil=True)
def _fill_row(image, y, start, stop, width, channels, border, out):
    """Columns [start, stop) of row y, which may lie outside the image; y < 0 is a row of zeros."""
    if y < 0:
        out[:] = 0.0
        return
    row = image[y]
    begin, end = max(start, 0), min(stop, width)
    for x in range(start, begin):
        _copy_pixel(row, _inside(x, width, border), out, x - start, channels)
    offset, count = u64(begin * channels), u64((end - begin) * channels)
    shift = u64((begin - start) * channels)
    for q in range(count):
        out[shift + q] = row[offset + q]
    for x in range(end, stop):
        _copy_pixel(row, _inside(x, width, border), out, x - start, channels)


@njit(cache=True, nogil=True)
def _copy_pixel(row, x, out, at, channels):
    for c in range(channels):
        out[at * channels + c] = row[x * channels + c] if x >= 0 else 0.0


@njit(cache=True, nogil=True, fastmath={"contract"})
def _filter_row(row, weights, step, count, out):
    """out[x] = sum over k of weights[k] row[x + k step]."""
    for k in range(0, len(weights), GROUP):
        w0, w1, w2, w3, w4, w5 = _group(weights, k)
        a, b, c = u64(k * step), u64((k + 1) * step), u64((k + 2) * step)
        d, e, f = u64((k + 3) * step), u64((k + 4) * step), u64((k + 5) * step)
        if k == 0:
            for x in range(u64(count)):
                out[x] = (w0 * row[x + a] + w1 * row[x + b]) + (w2 * row[x + c] + w3 * row[x + d])
                out[x] += w4 * row[x + e] + w5 * row[x + f]
        else:
            for x in range(u64(count)):
                out[x] += (w0 * row[x + a] + w1 * row[x + b]) + (w2 * row[x + c] + w3 * row[x + d])
                out[x] += w4 * row[x + e] + w5 * row[x + f]


@njit(cache=True, nogil=True, fastmath={"contract"})
def _filter_column(ring, weights, head, taps, first, last, out):
    """out[x] = sum over k of weights[k] ring[(head + k) % taps, x] for first <= x < last."""
    for k in range(0, len(weights), GROUP):
        w0, w1, w2, w3, w4, w5 = _group(weights, k)
        a, b, c = ring[(head + k) % taps], ring[(head + k + 1) % taps], ring[(head + k + 2) % taps]
        d, e, f = ring[(head + k + 3) % taps], ring[(head + k + 4) % taps], ring[(head + k + 5) % taps]
        if k == 0:
            for x in range(u64(first), u64(last)):
                out[x] = (w0 * a[x] + w1 * b[x]) + (w2 * c[x] + w3 * d[x]) + (w4 * e[x] + w5 * f[x])
        else:
            for x in range(u64(first), u64(last)):
                out[x] += (w0 * a[x] + w1 * b[x]) + (w2 * c[x] + w3 * d[x]) + (w4 * e[x] + w5 * f[x])


@njit(cache=True, nogil=True)
def _group(weights, k):
    return weights[k], weights[k + 1], weights[k + 2], weights[k + 3], weights[k + 4], weights[k + 5]


@njit(cache=True, nogil=True, fastmath={"contract"})
def _similarity(mean_s, mean_d, square_s, square_d, unbias, c1, c2, first, last, out):
    """SSIM from the four window means: luminance times contrast and structure, one division."""
    for x in range(u64(first), u64(last)):
        s, d = mean_s[x] * mean_s[x], mean_d[x] * mean_d[x]
        var_s, var_d = unbias * (square_s[x] - s), unbias * (square_d[x] - d)
        out[x] = ((s - d + c1) * (var_s - var_d + c2)) / ((s + d + c1) * (var_s + var_d + c2))


@njit(cache=True, nogil=True)
def sum_and_difference(pred, truth, inside, paint, s, d):
    """x + y and x - y of two images [h, w, C] into s and d [h, w, C], both images painted outside the mask [h, w].

    paint [C]: the painted value; a mask without pixels [0, 0] paints nothing
    """
    height, width, channels = pred.shape
    every = inside.size == 0
    for y in range(u64(height)):
        for x in range(u64(width)):
            if every or inside[y, x]:
                for c in range(u64(channels)):
                    a, b = np.float64(pred[y, x, c]), np.float64(truth[y, x, c])
                    s[y, x, c] = a + b
                    d[y, x, c] = a - b
            else:
                for c in range(u64(channels)):
                    s[y, x, c] = 2.0 * paint[c]
                    d[y, x, c] = 0.0


@njit(cache=True, nogil=True, fastmath={"contract"})
def _deficit(ssim, counts, first, last):
    """The sum of counts (1 - ssim): values near 1 keep their digits.

    Four sums side by side, in an order of our own: the compiler's differs between the process that compiles and those
    that load the code from numba's cache.
    """
    a = b = c = d = 0.0
    whole = first + (last - first) // 4 * 4
    for x in range(u64(first), u64(whole), u64(4)):
        a += counts[x] * (1.0 - ssim[x])
        b += counts[x + u64(1)] * (1.0 - ssim[x + u64(1)])
        c += counts[x + u64(2)] * (1.0 - ssim[x + u64(2)])
        d += counts[x + u64(3)] * (1.0 - ssim[x + u64(3)])
    for x in range(u64(whole), u64(last)):
        a += counts[x] * (1.0 - ssim[x])
    return (a + b) + (c + d)


@njit(cache=True, nogil=True)
def ssim_rows(s, d, channels, weights, taps, border, unbias, c1, c2, top, first, last, mask, keep, values):
    """The sum of 1 - SSIM over the masked pixels and channels of some rows.

    s, d [h, w C] float64: x + y and x - y; windows are cut at the array's edges by the border rule
    weights [n] float64: `taps` weights of the window, then zeros up to a multiple of GROUP
    unbias: what the variances and the covariance are multiplied by, 1 for population moments
    c1, c2: the constants, each times 2
    top, first [m], last [m]: the pixels of row top + i from column first[i] to last[i], not included, are wanted
    mask [m, w] bool: the pixels that count
    keep, values [m, w C]: whether to store SSIM itself, and where
    """
    height, width = s.shape[0], s.shape[1] // channels
    radius = taps // 2
    left, right = width, 0
    for i in range(len(first)):
        if first[i] < last[i]:
            left, right = min(left, first[i]), max(right, last[i])
    if left >= right:
        return 0.0
    count = (right - left) * channels
    step = channels
    padded = count + (len(weights) - 1) * step
    row_s, row_d = np.zeros(padded), np.zeros(padded)
    row_ss, row_dd = np.zeros(padded), np.zeros(padded)
    stride = count + -count % 8  # rows begin at cache lines, an odd number of them apart: else they evict each other
    stride += 8 if stride % 16 == 0 else 0
    ring = np.zeros((4, taps, stride))
    means = np.zeros((4, count))
    ssim, counts = np.zeros(count), np.zeros(count)
    total = 0.0
    for i in range(len(first) + 2 * radius):
        y = _inside(top + i - radius, height, border)
        _fill_row(s, y, left - radius, right + radius, width, channels, border, row_s)
        _fill_row(d, y, left - radius, right + radius, width, channels, border, row_d)
        for q in range(u64(padded)):
            row_ss[q] = row_s[q] * row_s[q]
            row_dd[q] = row_d[q] * row_d[q]
        _filter_row(row_s, weights, step, count, ring[0, i % taps])
        _filter_row(row_d, weights, step, count, ring[1, i % taps])
        _filter_row(row_ss, weights, step, count, ring[2, i % taps])
        _filter_row(row_dd, weights, step, count, ring[3, i % taps])
        j = i - 2 * radius
        if j < 0 or first[j] >= last[j]:
            continue
        begin, end = (first[j] - left) * channels, (last[j] - left) * channels
        for moment in range(4):
            _filter_column(ring[moment], weights, (i + 1) % taps, taps, begin, end, means[moment])
        _similarity(means[0], means[1], means[2], means[3], unbias, c1, c2, begin, end, ssim)
        for p in range(first[j], last[j]):
            weight = 1.0 if mask[j, p] else 0.0
            for c in range(channels):
                counts[(p - left) * channels + c] = weight
        total += _deficit(ssim, counts, begin, end)
        if keep:
            for x in range(begin, end):
                values[j, left * channels + x] = ssim[x]
    return total
