"""Several lanes side by side in C++: their numbers are vectors of the compiler, with one number for each lane.

All of them go through the same code. What holds for a lane is a number of which all bits are set, so that both ways of a choice are
computed and one is taken by these bits; a loop goes on while it does for any of the lanes, and changes nothing of the others.
"""

from .c_functions import OF_ONE, OF_TWO

# Types in C++ of the numbers of lanes, by the type of one lane's.
REALS, TRUTHS, WHOLES = "reals", "truths", "wholes"
OF_LANES = {
    "double": REALS,
    "bool": TRUTHS,
    "int": WHOLES,
    "long long": WHOLES,
    "unsigned": WHOLES,
    "unsigned long long": WHOLES,
}
KINDS = (REALS, TRUTHS, WHOLES)
# The primitives that are written in another way than for one lane.
BY_NUMBER = {
    "sign": "({0} > (reals)(0.0) ? (reals)(1.0) : ({0} < (reals)(0.0) ? (reals)(-1.0) : {0}))",
    "exp2": "wp::pow((reals)(2.0), {})",
    "log1p": "wp::log1p({})",
    "expm1": "wp::expm1({})",
    "is_finite": "({0} - {0} == (reals)(0.0))",
    "not": "~{}",
    "max": "((({0} > {1}) | ({0} != {0})) ? {0} : {1})",
    "min": "((({0} < {1}) | ({0} != {0})) ? {0} : {1})",
}
ALL, NONE = "(truths)(-1)", "(truths)(0)"


def declarations(lanes: int) -> str:
    """The types of so many lanes' numbers, their functions, and arrays that have a row for each lane."""
    lines = [
        f"typedef double reals __attribute__((ext_vector_type({lanes})));",
        "typedef decltype(reals() < reals()) truths;",
        "typedef truths wholes;",
        _each("bool any(const truths which)", "long long found = 0;", "found |= which[l];", "return found != 0;", lanes),
        *(_of_numbers(name, ("x",), f"::{name}") for name in OF_ONE if name != "sqrt"),
        *(_of_numbers(name, ("x", "y"), f"::{name}") for name in OF_TWO),
        *(_of_numbers(name, ("x",), f"__builtin_{name}") for name in ("sqrt", "log1p", "expm1")),
        _of_numbers("fmod", ("x", "y"), "__builtin_fmod"),
        "namespace wp { static inline reals abs(const reals x) { return __builtin_elementwise_abs(x); } }",
        # Numbers at places of arrays that differ from lane to lane.
        "template <class T> static inline T picked(const T* all, const wholes at) {",
        f"  T found; for (int l = 0; l < {lanes}; ++l) found[l] = all[at[l]][l]; return found; }}",
        "static inline reals picked(const double* all, const wholes at) {",
        f"  reals found; for (int l = 0; l < {lanes}; ++l) found[l] = all[at[l]]; return found; }}",
        "static inline wholes picked(const int* all, const wholes at) {",
        f"  wholes found; for (int l = 0; l < {lanes}; ++l) found[l] = all[at[l]]; return found; }}",
        "template <class T> static inline void put(T* all, const wholes at, const T own) {",
        f"  for (int l = 0; l < {lanes}; ++l) all[at[l]][l] = own[l]; }}",
        "template <class T> static inline void add(T* all, const wholes at, const T own) {",
        f"  for (int l = 0; l < {lanes}; ++l) all[at[l]][l] += own[l]; }}",
        # Each lane's own row.
        f"struct Rows {{ const double* of[{lanes}]; reals operator[](const long long at) const {{",
        f"  reals found; for (int l = 0; l < {lanes}; ++l) found[l] = of[l][at]; return found; }} }};",
        "struct Written { double* of; long long step, at; int lanes; void operator=(const reals own) const {",
        "  for (int l = 0; l < lanes; ++l) of[l * step + at] = own[l]; } };",
        "struct NewRows { double* of; long long step; int lanes; Written operator[](const long long at) const {",
        "  return {of, step, at, lanes}; } };",
    ]
    return "\n".join(line.replace("LANES", str(lanes)) for line in lines)


def _each(head: str, begin: str, one: str, end: str, lanes: int) -> str:
    return f"static inline {head} {{ {begin} for (int l = 0; l < {lanes}; ++l) {one} {end} }}"


def _of_numbers(name: str, numbers: tuple[str, ...], own: str) -> str:
    told, each = (", ".join(form.format(one) for one in numbers) for form in ("const reals {}", "{}[l]"))
    head = f"namespace wp {{ static inline reals {name}({told})"
    return f"{head} {{ reals found; for (int l = 0; l < LANES; ++l) found[l] = {own}({each}); return found; }} }}"


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
