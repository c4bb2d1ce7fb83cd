"""Headers for kernels whose code is all their own: what they use of Warp's headers, which take a compiler seconds to read.

They stand beside a kernel's code, where a compiler looks first. What a launch passes is declared in Warp's words, copied from
the Warp that is installed. Where that looks otherwise than expected, kernels are compiled with Warp's own headers.
"""

from pathlib import Path

# Between these words Warp's header says what the bounds of a launch are, and how a thread's number follows from them.
BEGIN = "static constexpr int LAUNCH_MAX_DIMS"
END = "template <int N> inline CUDA_CALLABLE_DEVICE void tid(int& i, int& j, size_t index"
# Functions that Warp calls as C does, of one number and of two.
ANGLES = ("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh")
OF_ONE = (*ANGLES, "sqrt", "cbrt", "exp", "log", "erf", "erfc", "floor", "ceil", "round", "rint")
OF_TWO = ("pow", "atan2")


def own_headers(wp) -> dict[str, str] | None:
    """The texts of the headers by name; None where Warp's are to be used."""
    try:
        text = (Path(wp.__file__).parent / "native" / "builtin.h").read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return None
    begin, end = text.find(BEGIN), text.find(END)
    if not 0 <= begin < end:
        return None
    one = [f"inline double {name}(double x) {{ return ::{name}(x); }}" for name in OF_ONE]
    two = [f"inline double {name}(double x, double y) {{ return ::{name}(x, y); }}" for name in OF_TWO]
    lines = [
        "#pragma once",
        '#include "crt.h"',
        "#define CUDA_CALLABLE",
        "#define CUDA_CALLABLE_DEVICE",
        "#define WP_NOINLINE __attribute__((noinline))",
        "#define WP_FORCEINLINE inline __attribute__((always_inline))",
        "namespace wp {",
        "typedef int int32;",
        "typedef unsigned long long uint64;",
        "typedef double float64;",
        "inline int32 add(int32 a, int32 b) { return a + b; }",
        "inline double abs(double x) { return ::fabs(x); }",
        *one,
        *two,
        text[begin:end],
        "class tile_shared_storage_t {};",
        "static tile_shared_storage_t* shared_tile_storage;",
        "}  // namespace wp",
        "",
    ]
    return {"builtin.h": "\n".join(lines), "deterministic.h": "#pragma once\n"}
