"""Elementary functions in single precision, written with additions, multiplications and bit operations.

A loop that calls a library function for each element is not vectorised. These forms are. They follow the published
approximations named with each; the largest error is a few units in the last place.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax import lax

LN2_HIGH, LN2_LOW = 0.693359375, -2.12194440e-4  # their sum is log 2
ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))


def polynomial(x: Any, *coefficients: float) -> Any:
    """The polynomial with these coefficients, the highest power first."""
    result: Any = coefficients[0]
    for coefficient in coefficients[1:]:
        result = result * x + coefficient
    return result


def exp(x: Any) -> Any:
    """e^x. Source: Moshier, Cephes, expf."""
    clipped = jnp.clip(x, -87.3, 88.7)
    power = jnp.floor(clipped * 1.44269504 + 0.5)
    rest = clipped - power * LN2_HIGH - power * LN2_LOW
    series = polynomial(
        rest, 1.9875691500e-4, 1.3981999507e-3, 8.3334519073e-3, 4.1665795894e-2, 1.6666665459e-1, 5.0000001201e-1
    )
    scale = lax.bitcast_convert_type((power.astype(jnp.int32) + 127) << 23, jnp.float32)
    result = (series * rest * rest + rest + 1.0) * scale
    return jnp.where(x > 88.7, jnp.inf, jnp.where(x < -87.3, 0.0, jnp.where(x == x, result, x)))


def log(x: Any) -> Any:
    """The natural logarithm of normal numbers; -inf at 0, NaN below. Source: Moshier, Cephes, logf."""
    bits = lax.bitcast_convert_type(x, jnp.int32)
    exponent = (((bits >> 23) & 0xFF) - 126).astype(jnp.float32)
    mantissa = lax.bitcast_convert_type((bits & 0x7FFFFF) | 0x3F000000, jnp.float32)
    small = mantissa < 0.707106781186547524
    exponent = exponent - jnp.where(small, 1.0, 0.0)
    m = jnp.where(small, mantissa + mantissa, mantissa) - 1.0
    series = polynomial(
        m, 7.0376836292e-2, -1.1514610310e-1, 1.1676998740e-1, -1.2420140846e-1, 1.4249322787e-1, -1.6668057665e-1,
        2.0000714765e-1, -2.4999993993e-1, 3.3333331174e-1,
    )  # fmt: skip
    square = m * m
    result = m + (series * m * square + exponent * LN2_LOW - 0.5 * square) + exponent * LN2_HIGH
    special = jnp.where(x == 0, -jnp.inf, jnp.where(x == jnp.inf, jnp.inf, jnp.nan))
    return jnp.where((x > 0) & (x < jnp.inf), result, special)


def log1p(x: Any) -> Any:
    """log(1 + x), exact for small x. Source: Kahan's correction (Higham, Accuracy and Stability, section 1.14.1)."""
    plus = 1.0 + x
    back = plus - 1.0
    corrected = log(plus) * (x / jnp.where(back == 0, 1.0, back))
    return jnp.where(back == 0, x, corrected)


def tanh(x: Any) -> Any:
    """The hyperbolic tangent. Source: the rational approximation of Eigen's ptanh, as in XLA."""
    small = jnp.clip(x, -7.90531110763549805, 7.90531110763549805)
    square = small * small
    top = polynomial(
        square, -2.76076847742355e-16, 2.00018790482477e-13, -8.60467152213735e-11, 5.12229709037114e-08,
        1.48572235717979e-05, 6.37261928875436e-04, 4.89352455891786e-03,
    )  # fmt: skip
    bottom = polynomial(square, 1.19825839466702e-06, 1.18534705686654e-04, 2.26843463243900e-03, 4.89352518554385e-03)
    return jnp.where(jnp.abs(x) < 0.0004, x, small * top / bottom)


def _sine_and_cosine(x: Any) -> tuple[Any, Any, Any]:
    """The quadrant of an angle, and sine and cosine of what is left. Source: Moshier, Cephes, sinf and cosf."""
    quadrant = jnp.floor(x * 0.636619772367581 + 0.5)
    rest = x - quadrant * 1.5703125 - quadrant * 4.837512969970703125e-4 - quadrant * 7.549789948768648e-8
    square = rest * rest
    sine = polynomial(square, -1.9515295891e-4, 8.3321608736e-3, -1.6666654611e-1) * square * rest + rest
    cosine = polynomial(square, 2.443315711809948e-5, -1.388731625493765e-3, 4.166664568298827e-2) * square * square
    return quadrant.astype(jnp.int32), sine, cosine - 0.5 * square + 1.0


def sin(x: Any) -> Any:
    """The sine of angles up to a few thousand radians."""
    quadrant, sine, cosine = _sine_and_cosine(x)
    value = jnp.where((quadrant & 1) == 1, cosine, sine)
    return jnp.where((quadrant & 2) == 2, -value, value)


def cos(x: Any) -> Any:
    """The cosine of angles up to a few thousand radians."""
    quadrant, sine, cosine = _sine_and_cosine(x)
    value = jnp.where((quadrant & 1) == 1, sine, cosine)
    return jnp.where(((quadrant + 1) & 2) == 2, -value, value)


def atan2(y: Any, x: Any) -> Any:
    """The angle of (x, y) in [-pi, pi], 0 at the origin. Source: Moshier, Cephes, atanf."""
    across, along = jnp.abs(y), jnp.abs(x)
    large, small = jnp.maximum(across, along), jnp.minimum(across, along)
    ratio = small / jnp.where(large == 0, 1.0, large)  # in [0, 1]
    middle = ratio > 0.4142135623730950
    t = jnp.where(middle, (ratio - 1.0) / (ratio + 1.0), ratio)
    square = t * t
    series = polynomial(square, 8.05374449538e-2, -1.38776856032e-1, 1.99777106478e-1, -3.33329491539e-1)
    angle = jnp.where(middle, 0.7853981633974483, 0.0) + (series * square * t + t)
    angle = jnp.where(across > along, 1.5707963267948966 - angle, angle)
    angle = jnp.where(x < 0, 3.141592653589793 - angle, angle)
    return jnp.where(y < 0, -angle, angle)


def asin(x: Any) -> Any:
    """The angle in [-pi/2, pi/2] whose sine is x."""
    return atan2(x, jnp.sqrt((1.0 - x) * (1.0 + x)))


def acos(x: Any) -> Any:
    """The angle in [0, pi] whose cosine is x."""
    return atan2(jnp.sqrt((1.0 - x) * (1.0 + x)), x)


def erf_inv(x: Any) -> Any:
    """The inverse error function. Source: Giles, Approximating the erfinv function, GPU Computing Gems 2011."""
    w = -log1p(-x * x)
    central = polynomial(
        w - 2.5, 2.81022636e-08, 3.43273939e-07, -3.5233877e-06, -4.39150654e-06, 0.00021858087, -0.00125372503,
        -0.00417768164, 0.246640727, 1.50140941,
    )  # fmt: skip
    tail = polynomial(
        jnp.sqrt(w) - 3.0, -0.000200214257, 0.000100950558, 0.00134934322, -0.00367342844, 0.00573950773,
        -0.0076224613, 0.00943887047, 1.00167406, 2.83297682,
    )  # fmt: skip
    return x * jnp.where(w < 5.0, central, tail)


def power(x: Any, y: Any) -> Any:
    """x^y for x >= 0."""
    return jnp.where(x == 0, jnp.where(y == 0, 1.0, 0.0), exp(y * log(x)))


def threefry2x32(first: Any, second: Any, left: Any, right: Any) -> tuple[Any, Any]:
    """Two random words of a key (first, second) and a counter (left, right): Threefry-2x32 with 20 rounds.

    Source: Salmon et al., Parallel random numbers: as easy as 1, 2, 3, SC 2011.
    """
    schedule = (first, second, first ^ second ^ jnp.uint32(0x1BD11BDA))
    left, right = left + schedule[0], right + schedule[1]
    for group in range(5):
        for turn in ROTATIONS[group % 2]:
            left = left + right
            right = ((right << jnp.uint32(turn)) | (right >> jnp.uint32(32 - turn))) ^ left
        left = left + schedule[(group + 1) % 3]
        right = right + schedule[(group + 2) % 3] + jnp.uint32(group + 1)
    return left, right


# by the name of JAX's primitive
FUNCTIONS: dict[str, Callable[..., Any]] = {
    "acos": acos, "asin": asin, "atan2": atan2, "cos": cos, "erf_inv": erf_inv, "exp": exp, "log": log,
    "log1p": log1p, "pow": power, "sin": sin, "tanh": tanh, "threefry2x32": threefry2x32,
}  # fmt: skip
