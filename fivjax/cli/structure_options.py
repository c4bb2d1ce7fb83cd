"""Options for a structure from finite-element files in place of the oscillator, with the scene around it."""

import dataclasses
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

import fivjax as fj

from .options import SceneOptions
from .parsing import pairs

if TYPE_CHECKING:
    from ..model.scene import Scene
    from ..model.structure import Structure


@dataclasses.dataclass(frozen=True)
class StructureOptions(SceneOptions):
    """The scene; the defaults are the paper's. With --structure, a finite-element model in place of the oscillator."""

    structure: Path | None = None
    """file of a finite-element code with the stiffness (and perhaps mass and damping); formats: see `fj.read_structure`. The
    options from --units to --keep belong to it"""
    units: str | None = None
    """units of its files, such as SI or mm-t-s; they do not say"""
    mass: Path | None = None
    """file with the mass matrix, where it is not found beside the stiffness"""
    damping: Path | None = None
    """file with the damping matrix"""
    matrices: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ROLE=NAME …")] = ()
    """names of matrices in files that hold several, such as `stiffness=KAAX mass=MAAX`"""
    labels: Path | None = None
    """file with node and direction of each row, where the files do not say"""
    contacts: Path | None = None
    """file of contacts, .csv with the columns `node`, `along` (direction along the belt), `away` (away from it), and perhaps
    `against` (the other node; the belt where it is empty). Directions: x, -z, 1 to 6, or three numbers such as `0.6 0 0.8`"""
    contact: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NODE:ALONG:AWAY[:AGAINST] …")] = ()
    """contacts without a file, such as `17:x:-z`, or `17:x:-z:903` against another node"""
    load: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NODE:DIRECTION[=SHARE] …")] = ()
    """where --force acts, such as `903:z`, or `903:z=0.5 904:z=0.5`"""
    rayleigh: Annotated[tuple[float, float], tyro.conf.arg(metavar="A B")] = (0.0, 0.0)
    """damping that is added as A·M + B·K (1/s, s)"""
    damping_ratio: float = 0.0
    """share of critical damping that is added to each mode"""
    up_to: float = 3000.0
    """frequency up to which modes are kept (Hz)"""
    keep: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NODE:DIRECTION …")] = ()
    """further coordinates to keep, such as `5:x`"""

    def scene(self) -> "Scene":
        if self.structure is None:
            self._refuse_given(
                [option.name for option in dataclasses.fields(StructureOptions)][
                    len(dataclasses.fields(SceneOptions)) :
                ],
                "belongs to a structure from files; name its file by `--structure`",
            )
            return super().scene()
        if not self.load:
            raise ValueError(
                "Option `--load` is missing: nothing presses the contacts together. Name where the load acts, such as "
                "`--load 903:z`."
            )
        return self._around(self.reduced())

    def reduced(self) -> "Structure":
        """The structure of the files, reduced; what was found about it is printed.

        **Raises:** `ValueError`, which names options in place of arguments.
        """
        # What describes the oscillator.
        oscillator = ("m1", "m2", "c1", "c2", "k1", "k2", "theta")
        self._refuse_given(oscillator, "belongs to the oscillator, which `--structure` replaces; leave it out")
        contacts: Path | list = [node_contact(text) for text in self.contact]
        if self.contacts is not None:
            if contacts:
                raise ValueError(
                    "Options `--contact` and `--contacts` are two ways to give the contacts; give one of them."
                )
            contacts = self.contacts
        load = dict(_share(text) for text in self.load)
        if len(load) < len(self.load):
            raise ValueError(
                f"Option `--load` must name each direction of a node once, but is {' '.join(self.load)!r}."
            )
        keep = [_coordinate(text, "--keep") for text in self.keep]
        try:
            big = fj.read_structure(
                self.structure or "",
                units=self.units,
                mass=self.mass,
                damping=self.damping,
                names=pairs("--matrices", self.matrices, "ROLE=NAME, such as `stiffness=KAAX`"),
                labels=self.labels,
                contacts=contacts,
                load=load,
                rayleigh=self.rayleigh,
            )
            reduction = fj.craig_bampton(big, self.up_to, keep=keep, damping_ratio=self.damping_ratio)
        except (ValueError, TypeError) as error:
            raise ValueError(in_options(str(error))) from None
        print(in_options(str(big.checks)), reduction, sep="\n")
        return reduction.structure

    def _refuse_given(self, names, why: str) -> None:
        own = {option.name: option.default for option in dataclasses.fields(self)}
        given = next((name for name in names if getattr(self, name) != own[name]), None)
        if given is not None:
            raise ValueError(f"Option `--{given.replace('_', '-')}` {why}.")


def in_options(sentence: str) -> str:
    """A sentence about `read_structure` and `craig_bampton` with arguments replaced by options: `units` by `--units`."""
    sentence = sentence.replace("Give `contacts` to `read_structure`", "Give `--contacts` or `--contact`")
    sentence = re.sub(r"`names=\{'(\w+)': …\}`", r"`--matrices \1=…`", sentence)
    sentence = re.sub(r"Argument `names`", "Argument `matrices`", sentence)
    sentence = re.sub(r"Argument `contacts\[(\d+)\]`", lambda found: f"Contact {int(found[1]) + 1}", sentence)
    arguments = "units|mass|damping|labels|contacts|rayleigh|load|matrices|keep|damping_ratio|up_to"
    sentence = re.sub(
        rf"(Argument|with|by|of|or|and|but) `({arguments})(\[[^`]*)?`",
        lambda found: f"{found[1]} `--{found[2].replace('_', '-')}`",
        sentence,
    )
    return sentence.replace("Argument `--", "Option `--")


def node_contact(text: str) -> "fj.NodeContact":
    """A contact from `17:x:-z` or `17:x:-z:903`."""
    parts = text.split(":")
    if len(parts) not in (3, 4) or not all(parts[place].isdecimal() for place in (0, 3)[: len(parts) - 2]):
        raise ValueError(f"Option `--contact` must be NODE:ALONG:AWAY or NODE:ALONG:AWAY:AGAINST, but is {text!r}.")
    along, away = (int(part) if part.isdecimal() else part for part in parts[1:3])
    return fj.NodeContact(int(parts[0]), along, away, int(parts[3]) if len(parts) == 4 else None)


def _share(text: str) -> tuple[tuple[int, str | int], float]:
    place, equals, share = text.partition("=")
    node, colon, direction = place.partition(":")
    try:
        size = float(share) if equals else 1.0
        if not colon:
            raise ValueError
        return (int(node), int(direction) if direction.isdecimal() else direction), size
    except ValueError:
        raise ValueError(
            f"Option `--load` must be NODE:DIRECTION or NODE:DIRECTION=SHARE, such as `903:-z=0.5`, but is {text!r}."
        ) from None


def _coordinate(text: str, option: str) -> tuple[int, int | str]:
    node, _, direction = text.partition(":")
    if node.isdecimal() and (direction in ("x", "y", "z") or direction.isdecimal()):
        return int(node), int(direction) if direction.isdecimal() else direction
    raise ValueError(f"Option `{option}` must be NODE:DIRECTION, such as `5:x` or `5:1`, but is {text!r}.")
