"""Numbers in sentences, with as many digits as it takes to tell them apart."""

# What `:g` prints.
ORDINARY = 6


def apart(*values: float, digits: int = ORDINARY) -> tuple[str, ...]:
    """The numbers as text, those that differ looking different: "1.70809" and "1.7080901", not "1.70809" twice."""
    # With these, different numbers in double precision look different.
    most = 17
    numbers = [float(value) for value in values]
    different = len({number for number in numbers if number == number})
    while True:
        texts = tuple(f"{number:.{digits}g}" for number in numbers)
        if len(set(texts)) >= different or digits >= most:
            return texts
        digits += 1


def counted(count: int, one: str, several: str | None = None) -> str:
    """A count with its noun: "1 trajectory", "2 trajectories"."""
    return f"{count} {one if count == 1 else several or one + 's'}"
