"""Several lanes side by side in C++: their numbers are vectors of the compiler, with one number for each lane.

All of them go through the same code. What holds for a lane is a number of which all bits are set: both ways of a choice are
computed, and one is taken by these bits. A loop goes on while it does for any of the lanes, and changes nothing of the others.
"""

from .c_functions import OF_ONE, OF_TWO

# Types in C++ of the numbers of lanes, by the type of one lane's.
REALS, TRUTHS, WHOLES = "reals", "truths", "wholes"
OF_LANES = {
    "double": REALS,
    "bool": TRUTHS,
    "int": WHOLES,
    "signed char": WHOLES,
    "long long": WHOLES,
}
KINDS = (REALS, TRUTHS, WHOLES)
# By how many bits whole numbers of lanes are longer than one lane's; what may go beyond that one's number by number, and what
# does so by many numbers.
LONGER = {"int": 32, "signed char": 56}
GOING_BEYOND = ("add", "add_any", "sub", "mul", "neg", "square", "integer_pow")
ADDING = ("reduce_sum", "reduce_prod", "dot_general", "scatter-add")
# The primitives that are written in another way than for one lane.
BY_NUMBER = {
    "sign": "sign({})",
    "exp2": "wp::pow((reals)(2.0), {})",
    "log1p": "wp::log1p({})",
    "expm1": "wp::expm1({})",
    "asinh": "({0} < 0.0 ? (reals)(-1.0) : (reals)(1.0))"
    " * wp::log1p(wp::abs({0}) + wp::abs({0}) / (1.0 / wp::abs({0}) + wp::sqrt(1.0 + 1.0 / ({0} * {0}))))",
    "acosh": "wp::log1p({0} - 1.0 + wp::sqrt({0} - 1.0) * wp::sqrt({0} + 1.0))",
    "atanh": "({0} < 0.0 ? (reals)(-0.5) : (reals)(0.5)) * wp::log1p(2.0 * wp::abs({0}) / (1.0 - wp::abs({0})))",
    "is_finite": "({0} - {0} == (reals)(0.0))",
    "not": "~{}",
    "max": "((({0} > {1}) | ({0} != {0})) ? {0} : {1})",
    "min": "((({0} < {1}) | ({0} != {0})) ? {0} : {1})",
}
# Functions that processors have for vectors, and those that are written for them here.
BY_VECTORS = {"abs": "abs", "sqrt": "sqrt", "floor": "floor", "ceil": "ceil", "rint": "rint", "exp": "", "log": ""}
ALL = "(truths)(-1)"
# The exponential function and the logarithm, to about the last digit: by their series about zero, with powers of two apart.
SERIES = """
namespace wp {
static inline reals power_of_two(const wholes n) { return __builtin_bit_cast(reals, (n + (wholes)(1023)) << (wholes)(52)); }
static inline reals exp(const reals x) {
  const reals least = (reals)(-746.0), most = (reals)(710.0);
  reals in = (x < least ? least : x);
  in = (in > most ? most : in);
  const reals twos = rint(in * (reals)(1.4426950408889634));
  const reals rest = (in - twos * (reals)(6.93147180369123816490e-01)) - twos * (reals)(1.90821492927058770002e-10);
  reals sum = (reals)(1.0 / 6227020800.0);
  sum = sum * rest + (reals)(1.0 / 479001600.0);
  sum = sum * rest + (reals)(1.0 / 39916800.0);
  sum = sum * rest + (reals)(1.0 / 3628800.0);
  sum = sum * rest + (reals)(1.0 / 362880.0);
  sum = sum * rest + (reals)(1.0 / 40320.0);
  sum = sum * rest + (reals)(1.0 / 5040.0);
  sum = sum * rest + (reals)(1.0 / 720.0);
  sum = sum * rest + (reals)(1.0 / 120.0);
  sum = sum * rest + (reals)(1.0 / 24.0);
  sum = sum * rest + (reals)(1.0 / 6.0);
  sum = sum * rest + (reals)(0.5);
  sum = sum * rest * rest + rest + (reals)(1.0);
  const wholes n = __builtin_convertvector(twos, wholes), half = n >> (wholes)(1);
  const reals found = sum * power_of_two(half) * power_of_two(n - half);
  return (x != x ? x : found);
}
static inline reals log(const reals x) {
  const truths small = x < (reals)(2.2250738585072014e-308);
  const wholes bits = __builtin_bit_cast(wholes, (small ? x * (reals)(18014398509481984.0) : x));
  const wholes above = bits - (wholes)(0x3fe6a09e00000000ll);
  const wholes twos = above >> (wholes)(52);
  const reals f = __builtin_bit_cast(reals, bits - (twos << (wholes)(52))) - (reals)(1.0);
  const reals k = __builtin_convertvector(twos, reals) - (small ? (reals)(54.0) : (reals)(0.0));
  const reals s = f / ((reals)(2.0) + f), z = s * s, half = (reals)(0.5) * f * f;
  reals sum = (reals)(1.479819860511658591e-01);
  sum = sum * z + (reals)(1.531383769920937332e-01);
  sum = sum * z + (reals)(1.818357216161805012e-01);
  sum = sum * z + (reals)(2.222219843214978396e-01);
  sum = sum * z + (reals)(2.857142874366239149e-01);
  sum = sum * z + (reals)(3.999999999940941908e-01);
  sum = sum * z + (reals)(6.666666666666735130e-01);
  const reals low = s * (half + sum * z) + k * (reals)(1.90821492927058770002e-10);
  const reals found = k * (reals)(6.93147180369123816490e-01) - ((half - low) - f);
  const reals none = (x == (reals)(0.0) ? (reals)(-1.0 / 0.0) : (reals)(0.0 / 0.0));
  const truths whole = (x > (reals)(0.0)) & (x <= (reals)(1.7976931348623157e308));
  return (whole ? found : (x > (reals)(0.0) ? x : none));
}
}
"""


def within_bits(form: str, kind: str) -> str:
    """The form of a primitive whose result begins again at the other end where one lane's number of this type does."""
    return f"((({form}) << (wholes)({LONGER[kind]})) >> (wholes)({LONGER[kind]}))" if kind in LONGER else form


def declarations(lanes: int) -> str:
    """The types of so many lanes' numbers, their functions, and arrays that have a row for each lane."""
    lines = [
        "typedef double reals __attribute__((ext_vector_type(LANES)));",
        "typedef decltype(reals() < reals()) truths;",
        "typedef truths wholes;",
        "static inline bool any(const truths which) {"
        " long long found = 0; for (int l = 0; l < LANES; ++l) found |= which[l]; return found != 0; }",
        *(_of_numbers(name, ("x",), f"::{name}") for name in OF_ONE if name not in BY_VECTORS),
        *(_of_numbers(name, ("x", "y"), f"::{name}") for name in OF_TWO),
        *(_of_numbers(name, ("x",), f"__builtin_{name}") for name in ("log1p", "expm1")),
        *(_of_vectors(name, own) for name, own in BY_VECTORS.items() if own),
        _of_numbers("fmod", ("x", "y"), "__builtin_fmod"),
        SERIES,
        "template <class T> static inline T sign(const T x) {",
        "  return (x > (T)(0) ? (T)(1) : (x < (T)(0) ? (T)(-1) : x)); }",
        # Numbers at places of arrays that differ from lane to lane.
        "template <class T> static inline T picked(const T* all, const wholes at) {",
        "  T found; for (int l = 0; l < LANES; ++l) found[l] = all[at[l]][l]; return found; }",
        _picked("double", REALS, "all[at[l]]"),
        *(_picked(kind, WHOLES, "all[at[l]]") for kind in ("int", "signed char", "long long")),
        _picked("bool", TRUTHS, "-(long long)all[at[l]]"),
        "template <class T> static inline void put(T* all, const wholes at, const T own) {",
        "  for (int l = 0; l < LANES; ++l) all[at[l]][l] = own[l]; }",
        "template <class T> static inline void add(T* all, const wholes at, const T own) {",
        "  for (int l = 0; l < LANES; ++l) all[at[l]][l] += own[l]; }",
        # Each lane's own row.
        "struct Rows { const double* of[LANES]; reals operator[](const long long at) const {",
        "  reals found; for (int l = 0; l < LANES; ++l) found[l] = of[l][at]; return found; } };",
        "struct Written { double* of; long long step, at; int lanes; void operator=(const reals own) const {",
        "  for (int l = 0; l < lanes; ++l) of[l * step + at] = own[l]; } };",
        "struct NewRows { double* of; long long step; int lanes; Written operator[](const long long at) const {",
        "  return {of, step, at, lanes}; } };",
    ]
    return "\n".join(lines).replace("LANES", str(lanes))


def _of_numbers(name: str, numbers: tuple[str, ...], own: str) -> str:
    told, each = (", ".join(form.format(one) for one in numbers) for form in ("const reals {}", "{}[l]"))
    head = f"namespace wp {{ static inline reals {name}({told})"
    return f"{head} {{ reals found; for (int l = 0; l < LANES; ++l) found[l] = {own}({each}); return found; }} }}"


def _picked(kind: str, of_lanes: str, own: str) -> str:
    head = f"static inline {of_lanes} picked(const {kind}* all, const wholes at)"
    return f"{head} {{ {of_lanes} found; for (int l = 0; l < LANES; ++l) found[l] = {own}; return found; }}"


def _of_vectors(name: str, own: str) -> str:
    return f"namespace wp {{ static inline reals {name}(const reals x) {{ return __builtin_elementwise_{own}(x); }} }}"


def converted(text: str, own: str, kind: str) -> str:
    """The text of a number of this type, one lane's or of all, as the lanes' numbers of another type."""
    if own == kind:
        return text
    if own not in KINDS:
        return f"({TRUTHS})(-(long long)({text} != 0))" if kind == TRUTHS else f"({kind})({text})"
    if kind == TRUTHS:
        return f"({text} != ({own})(0))"
    if own == TRUTHS:
        text = f"(-{text})"
        return text if kind == WHOLES else f"__builtin_convertvector({text}, {kind})"
    return f"__builtin_convertvector({text}, {kind})"
