"""FFCx's kernels of expressions at points, for many points in one call, four of them at once where the processor can.

The source of a kernel is taken as it is, with vectors of four numbers in place of numbers: a kernel that has only
arithmetic, square roots and powers. Others are called for one point after the other.
"""

import ctypes
import re
from math import prod
from typing import Any

NAME = "evaluate_many"
_LINE = re.compile(r"""double\ \w+\ =\ [-\w+*/(),.\[\]\s]+; | A\[[\w*+\s]+\]\ \+=\ [\w.]+; | //.* | [{}]?
    | for\ \(int\ iq\ =\ 0;\ iq\ <\ 1;\ \+\+iq\)""", re.VERBOSE)  # fmt: skip
_DECLARED = re.compile(r"\bdouble (\w+) = (.*);")
_CALL, _POWER = re.compile(r"\b(\w+)\("), re.compile(r"\bpow\(\w+(\[\d+\])?, -?[\d.e+-]+\)")
_OTHERS = ("coordinate_dofs", "entity_local_index", "quadrature_permutation")  # arguments that no cell gives here
_LANES = """#if defined(__x86_64__)
#define HAS_LANES
typedef double four __attribute__((vector_size(32), aligned(8)));
#define LANES __attribute__((target("avx2,fma")))
static inline __attribute__((always_inline)) LANES four four_sqrt(four x)
{ for (int i = 0; i < 4; ++i) x[i] = __builtin_sqrt(x[i]); return x; }
static inline __attribute__((always_inline)) LANES four four_pow(four x, double y)
{ for (int i = 0; i < 4; ++i) x[i] = __builtin_pow(x[i], y); return x; }
#define sqrt(x) _Generic((x), four: four_sqrt, default: sqrt)(x)
#define pow(x, y) _Generic((x), four: four_pow, default: pow)(x, y)
static inline __attribute__((always_inline)) LANES void lanes(four* A, const four* w, const double* c)
BODY
static LANES void by_lanes(const double* const* values, const int32_t* sizes, int32_t fields, int32_t total,
                           const double* c, int64_t n, double* out)
{
  four A[COUNT], w[total + 1];
  for (int64_t p = 0; p < n; p += 4) {
    int32_t at = 0;
    for (int32_t j = 0; j < fields; ++j)
      for (int32_t k = 0; k < sizes[j]; ++k, ++at)
        for (int i = 0; i < 4; ++i) w[at][i] = values[j][(p + i < n ? p + i : n - 1) * sizes[j] + k];
    memset(A, 0, sizeof(A));
    lanes(A, w, c);
    for (int i = 0; i < 4 && p + i < n; ++i)
      for (int k = 0; k < COUNT; ++k) out[(p + i) * COUNT + k] = A[k][i];
  }
}
#endif
"""
_MANY = """
/* values: of each field (n, size). out: (n, COUNT). */
void evaluate_many(const double* const* values, const int32_t* sizes, int32_t fields, const double* c, int64_t n,
                   double* out)
{
  int32_t total = 0;
  for (int32_t j = 0; j < fields; ++j) total += sizes[j];
#ifdef HAS_LANES
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) {
    by_lanes(values, sizes, fields, total, c, n, out);
    return;
  }
#endif
  double w[total + 1];
  memset(out, 0, n * COUNT * sizeof(double));
  for (int64_t p = 0; p < n; ++p) {
    int32_t at = 0;
    for (int32_t j = 0; j < fields; ++j)
      for (int32_t k = 0; k < sizes[j]; ++k) w[at++] = values[j][p * sizes[j] + k];
    KERNEL(out + p * COUNT, w, c, NONE);
  }
}
"""


def with_many(code: str) -> str:
    """The C code of one expression at one point with the function `evaluate_many`; unchanged if it is none."""
    found = re.search(r"void (tabulate_tensor_\w+)\(([^)]*)\)\n(\{\n.*?\n\})\n+static double points_", code, re.DOTALL)
    shapes = re.findall(r"int value_shape_\w+\[\d+\] = \{([\d, ]+)\}", code)
    if not found or len(shapes) > 1 or code.count("void tabulate_tensor_") > 1:
        return code
    kernel, arguments, body = found.groups()
    if any(re.search(rf"\b{name}\b", body) for name in _OTHERS):
        return code
    lanes = _LANES.replace("BODY", _DECLARED.sub(r"__auto_type \1 = 1.0 * (\2);", body)) if _has_lanes(body) else ""
    none = ", ".join("0" * (arguments.count(",") - 2))  # of the arguments after A, w and c
    many = _MANY.replace("KERNEL", f"({kernel})").replace("NONE", none)
    count = prod(int(size) for shape in shapes for size in shape.split(","))
    return code + (lanes + many).replace("COUNT", str(count))


def _has_lanes(body: str) -> bool:
    """Whether a kernel's body has only what a vector can replace a number in."""
    calls = {*_CALL.findall(body)} - {"for"}
    powers = len(_POWER.findall(body)) == len(re.findall(r"\bpow\(", body))
    return calls <= {"sqrt", "pow"} and powers and all(_LINE.fullmatch(line.strip()) for line in body.splitlines())


def declared(library: ctypes.CDLL) -> Any:
    """The function of a library, with its types; None if it has none."""
    try:
        many = library[NAME]
    except AttributeError:
        return None
    pointer = ctypes.c_void_p
    many.argtypes, many.restype = [pointer, pointer, ctypes.c_int32, pointer, ctypes.c_int64, pointer], None
    return many
