"""Linear systems in C++: a function of its own for each size, because to write one out takes hundreds of lines each time."""

from collections.abc import Callable

from ..foundation.jaxprs import within
from ..foundation.linear_solve import fivjax_elimination, is_elimination
from .cpp_arrays import Value
from .cpp_lanes import REALS
from .cpp_numbers import WIDE
from .cpp_writer import Writer

# `linear_solve.eliminated`, in place: the right sides become the solutions.
TEXT = """
const auto {name} = [](double* matrix, {kind}* right) __attribute__((noinline)) {{
  for (int k = 0; k < {n}; ++k) {{
    int place = k;
    for (int i = k + 1; i < {n}; ++i) if (wp::abs(matrix[i * {n} + k]) > wp::abs(matrix[place * {n} + k])) place = i;
    const double divisor = matrix[place * {n} + k];
    for (int j = 0; j < {n}; ++j) {{
      const double own = matrix[place * {n} + j] / divisor;
      matrix[place * {n} + j] = matrix[k * {n} + j];
      matrix[k * {n} + j] = own;
    }}
    for (int j = 0; j < {sides}; ++j) {{
      const {kind} own = right[place * {sides} + j] / divisor;
      right[place * {sides} + j] = right[k * {sides} + j];
      right[k * {sides} + j] = own;
    }}
    for (int i = 0; i < {n}; ++i) {{
      if (i == k) continue;
      const double factor = matrix[i * {n} + k];
      for (int j = 0; j < {n}; ++j) matrix[i * {n} + j] -= factor * matrix[k * {n} + j];
      for (int j = 0; j < {sides}; ++j) right[i * {sides} + j] -= factor * right[k * {sides} + j];
    }}
  }}
}};
"""
# The same for lanes side by side, of which each has its own largest number.
TEXT_OF_LANES = """
const auto {name} = [](reals* matrix, reals* right) __attribute__((noinline)) {{
  for (int k = 0; k < {n}; ++k) {{
    reals largest = wp::abs(matrix[k * {n} + k]);
    wholes place = (wholes)(k);
    for (int i = k + 1; i < {n}; ++i) {{
      const reals own = wp::abs(matrix[i * {n} + k]);
      place = (own > largest ? (wholes)(i) : place);
      largest = (own > largest ? own : largest);
    }}
    for (int i = k + 1; i < {n}; ++i) {{
      const truths here = place == (wholes)(i);
      if (!any(here)) continue;
      for (int j = 0; j < {n}; ++j) {{
        const reals own = matrix[i * {n} + j];
        matrix[i * {n} + j] = (here ? matrix[k * {n} + j] : own);
        matrix[k * {n} + j] = (here ? own : matrix[k * {n} + j]);
      }}
      for (int j = 0; j < {sides}; ++j) {{
        const reals own = right[i * {sides} + j];
        right[i * {sides} + j] = (here ? right[k * {sides} + j] : own);
        right[k * {sides} + j] = (here ? own : right[k * {sides} + j]);
      }}
    }}
    const reals divisor = matrix[k * {n} + k];
    for (int j = 0; j < {n}; ++j) matrix[k * {n} + j] /= divisor;
    for (int j = 0; j < {sides}; ++j) right[k * {sides} + j] /= divisor;
    for (int i = 0; i < {n}; ++i) {{
      if (i == k) continue;
      const reals factor = matrix[i * {n} + k];
      for (int j = 0; j < {n}; ++j) matrix[i * {n} + j] -= factor * matrix[k * {n} + j];
      for (int j = 0; j < {sides}; ++j) right[i * {sides} + j] -= factor * right[k * {sides} + j];
    }}
  }}
}};
"""


def _eliminated(writer: Writer, equation, operands: list[Value]) -> list[Value]:
    """The solutions for all right sides (columns)."""
    # Smaller systems are written out: in many of them zeros are known, and leave little.
    least = 4
    matrix, right = operands
    of_lanes = writer.lanes and any(map(writer.is_wide, operands))
    if not is_elimination(equation) or matrix.shape[0] < least or (writer.is_wide(matrix) and not of_lanes):
        called = within(equation.params)
        assert called is not None
        return writer.run(called.jaxpr, called.consts, operands)
    n, sides = right.shape
    kind = REALS if of_lanes else WIDE if writer.is_wide(right) else "double"
    name = f"eliminated_{n}_{sides}_{kind}"
    text = TEXT_OF_LANES if of_lanes else TEXT
    writer.functions[name] = text.format(name=name, n=n, sides=sides, kind=kind)
    own = [writer.new(matrix.shape, REALS if of_lanes else "double"), writer.new(right.shape, kind)]
    for value, into in zip(operands, own, strict=True):
        writer.copy(value, into.base, into.kind)
    writer.put(f"{name}({own[0].base}, {own[1].base});")
    return [writer.small(own[1])]


CALLS: dict[str, Callable] = {fivjax_elimination.__name__: _eliminated}
