"""The commands with a finite-element model in place of the oscillator: as the page shows them, and what they refuse."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

import fivjax as fj
from fivjax import cli
from fivjax.io.node_contacts import read_contacts
from tests.helpers.refusing import EngineReached, refused_on_the_command_line, untouched, without_engines

PAGE = (Path(__file__).parents[2] / "docs" / "howto" / "structure.md").read_text()
SECTION = PAGE.split("### On the command line")[1].split("### ")[0]
COMMANDS = dict.fromkeys(line for line in SECTION.splitlines() if line.startswith("fivjax "))
CONTACTS = re.search(r"```text\n(node,.*?)```", SECTION, re.DOTALL)[1]
# Two nodes with directions x and z; N/mm and t. The contact's node is coupled across the directions, so that friction couples modes.
PLACES = ((17, 1), (17, 3), (903, 1), (903, 3))
STIFFNESS = np.array([[300.0, 60, -100, 0], [60, 250, 0, -50], [-100, 0, 200, 20], [0, -50, 20, 180]])
MASS = np.diag([2e-3, 2e-3, 1e-3, 1e-3])


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The files that the page names."""
    for name, matrix in (("STIF", STIFFNESS), ("MASS", MASS)):
        entries = zip(*np.nonzero(np.tril(matrix)), strict=True)
        lines = ("{},{}, {},{}, {}\n".format(*PLACES[i], *PLACES[j], matrix[i, j]) for i, j in entries)
        (tmp_path / f"{name}.mtx").write_text("".join(lines))
    (tmp_path / "contacts.csv").write_text(CONTACTS)
    monkeypatch.chdir(tmp_path)
    without_engines(monkeypatch)
    return tmp_path


def words(command: str) -> list[str]:
    (line,) = (line for line in COMMANDS if line.startswith(f"fivjax {command} "))
    return shlex.split(line)[1:]


def test_the_page_shows_every_command():
    assert [line.split()[1] for line in COMMANDS] == ["cea", "simulate", "map", "cycle", "branch"]


@pytest.mark.parametrize("command", ["cea", "branch"])
def test_help_says_what_a_file_of_contacts_holds(command, capsys):
    with pytest.raises(SystemExit):
        cli.main([command, "--help"])
    said = " ".join(re.sub(r"[│\n]", " ", capsys.readouterr().out).split())
    assert "columns `node`, `along` (direction along the belt), `away`" in said and "`against`" in said


def test_complex_eigenvalues_of_files(folder, capsys):
    """The page's command: frequencies at zero friction are those of the matrices with the gap closed, by NumPy."""
    assert cli.main(words("cea")) == 0
    said = capsys.readouterr().out
    assert "Total mass: 3 kg along x, 0 kg along y, 3 kg along z" in said and "critical friction" in said
    free = np.delete(np.arange(4), 1)
    squares = np.linalg.eigvals(np.linalg.solve(MASS, STIFFNESS)[np.ix_(free, free)])
    found = fj.open(folder / "cea.nc")
    np.testing.assert_allclose(
        found["frequency"].isel(mu=0), np.sqrt(np.sort(squares)) / (2 * np.pi) * np.sqrt(1 - 0.002**2), rtol=1e-4
    )
    assert found.sizes["mu"] == 61 and (folder / "cea.png").is_file()


@pytest.mark.parametrize("command", ["simulate", "map", "cycle", "branch"])
def test_the_scene_of_files(command, folder, monkeypatch):
    """The other commands of the page get a scene with the reduced structure, its load and its damping."""
    scenes = []

    def noted(scene, *_, **__):
        scenes.append(scene)
        raise EngineReached

    for name in ("simulate", "bistability_map", "limit_cycle", "continue_cycle"):
        monkeypatch.setattr(fj, name, noted)
    with pytest.raises(EngineReached):
        cli.main(words(command))
    (scene,) = scenes
    structure = scene.structure
    assert structure.size == 4 and len(structure.contacts) == 1
    squares = np.sort(np.linalg.eigvals(np.linalg.solve(structure.mass, structure.stiffness)))
    np.testing.assert_allclose(squares, np.sort(np.linalg.eigvals(np.linalg.solve(MASS, STIFFNESS))), rtol=1e-9)
    # A force of 1 N at node 903 along z moves the contact as it does in the model (N/mm into m/N).
    moved = np.linalg.solve(structure.stiffness, structure.load_direction)
    wanted = np.linalg.solve(1e3 * STIFFNESS, [0, 0, 0, 1.0])
    np.testing.assert_allclose(moved[[structure.tangential, structure.normal]], [wanted[0], -wanted[1]], rtol=1e-9)
    mass, damping, stiffness = map(np.asarray, structure.matrices[:3])
    if command == "map":
        np.testing.assert_allclose(damping, 5 * mass + 1e-7 * stiffness, atol=1e-9)
    else:
        assert not np.any(damping)
    assert float(scene.belt_speed) == 3.0 and float(scene.load.force) == (50.0 if command == "simulate" else 100.0)


MODEL = ["--structure", "STIF.mtx", "--mass", "MASS.mtx", "--units", "mm-t-s", "--contacts", "contacts.csv"]
REFUSED = {
    "no units": (["cea", *MODEL[:4], *MODEL[6:]], "Option `--units` must be one of 'SI', 'mm-t-s'"),
    "no mass": (["cea", *MODEL[:2], *MODEL[4:]], "Give its file with `--mass`, or its name with `--matrices mass=…`."),
    "no contacts": (["cea", *MODEL[:6]], "has no contacts to reduce it onto. Give `--contacts` or `--contact`."),
    "contacts twice": (["cea", *MODEL, "--contact", "17:x:-z"], "Options `--contact` and `--contacts` are two ways"),
    "no load": (["simulate", *MODEL], "Option `--load` is missing: nothing presses the contacts together."),
    "no load, falling friction": (["cea", *MODEL, "--x", "belt_speed=1:2:5"], "Option `--load` is missing: without it"),
    "half a load": (["map", *MODEL, "--load", "903"], "Option `--load` must be NODE:DIRECTION or"),
    "a load twice": (
        ["map", *MODEL, "--load", "903:z", "903:z"],
        "Option `--load` must name each direction of a node once",
    ),
    "a load nowhere": (["cycle", *MODEL, "--load", "904:z"], "Node 904 is not in the matrices"),
    "no coordinate": (["branch", *MODEL, "--load", "903:z", "--keep", "903"], "Option `--keep` must be NODE:DIRECTION"),
    "a coordinate nowhere": (
        ["cea", *MODEL, "--keep", "903:y"],
        "Option `--keep` must hold coordinates of the structure",
    ),
    "negative damping": (
        ["cea", *MODEL, "--rayleigh", "-1", "0"],
        "Option `--rayleigh` must be non-negative, but is -1",
    ),
    "damping below zero": (["cea", *MODEL, "--damping-ratio", "-1"], "Option `--damping-ratio` must be non-negative"),
    "a role that is none": (["cea", *MODEL, "--matrices", "spring=K"], "Option `--matrices` must name stiffness"),
    "half a role": (["cea", *MODEL, "--matrices", "stiffness"], "Option `--matrices` must read ROLE=NAME"),
    "two models": (["cea", *MODEL, "--k1", "1e5", "--theta", "0.02"], "Option `--theta` belongs to the oscillator"),
    "a mass without a structure": (
        ["simulate", "--mass", "MASS.mtx"],
        "Option `--mass` belongs to a structure from files",
    ),
    "no such contacts": (["cea", *MODEL[:7], "none.csv"], "File `none.csv` of contacts does not exist."),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_fit_is_refused_by_its_option(case, folder, capsys):
    """In one sentence, before anything compiles, and without a file written."""
    arguments, said = REFUSED[case]
    with untouched(folder):
        assert said in refused_on_the_command_line(capsys, arguments)


DAMAGED = {
    "": r"is empty. Its columns are node, along, away",
    "node,along,away\n": r"holds no contact",
    "node,along\n1,x\n": r"line 1: the columns must be node, along, away, and perhaps against, but are node, along",
    "node,along,away,mu\n1,x,z,2\n": r"the columns must be",
    "# two\nnode;along;away\n1;x;-z\na;x;z\n": r"line 4: `node` must be the number of a node, but is 'a'",
    "node,along,away\n1,x\n": r"line 2: 3 fields expected \(node, along, away\), 2 found",
    "node,along,away\n1,x,up\n": r"line 2: `away` must be a direction such as x, -z, 2 or three numbers .* but is 'up'",
    "node,along,away\n1,0 0 0,z\n": r"line 2: `along` must be a direction",
    "node,along,away,against\n1,x,z,b\n": r"line 2: `against` must be the number of a node",
}


@pytest.mark.parametrize("text", DAMAGED)
def test_a_damaged_file_of_contacts_is_refused(text, tmp_path):
    (tmp_path / "contacts.csv").write_text(text)
    with pytest.raises(ValueError, match=DAMAGED[text]):
        read_contacts(tmp_path / "contacts.csv")


def test_contacts_as_spreadsheets_write_them(tmp_path):
    """With a mark of the byte order, capitals, semicolons, columns in another order, and directions of each kind."""
    (tmp_path / "c.csv").write_text("\ufeffAway;Along;Node;Against\r\n-z;x;17;\r\n2;0.6 0 0.8;4;9\r\n", newline="")
    assert read_contacts(tmp_path / "c.csv") == [
        fj.NodeContact(17, "x", "-z"),
        fj.NodeContact(4, (0.6, 0.0, 0.8), 2, against=9),
    ]


@pytest.mark.slow
@pytest.mark.parametrize(("command", "smaller"), [("simulate", []), ("map", ["--x", "mu=0.2:0.4:2", "--y", "p=1:2:2"])])
def test_commands_of_the_page_run(command, smaller, folder, monkeypatch, capsys):
    """From files to a written result, the map at a smaller size."""
    monkeypatch.undo()
    monkeypatch.chdir(folder)
    monkeypatch.setattr("fivjax.cli.command_line.keep_compiled_code", lambda: None)
    assert cli.main([*words(command), *smaller]) == 0, capsys.readouterr()
