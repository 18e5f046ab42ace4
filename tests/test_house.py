"""The rules of the house: imports go downward only, effects are known by their files, one module talks, one draws."""

from __future__ import annotations

import ast
import functools
import importlib.metadata
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

import spadmnist
from spadmnist.effects import STAGES, Effect

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "spadmnist"
MODULES = {str(p.relative_to(PACKAGE)): p for p in sorted(PACKAGE.rglob("*.py"))}

# a module imports from layers below its own, and within its own only along an arrow
LAYERS = [
    {"errors", "foreign", "heap", "interrupts", "units", "streams", "light", "system", "imported"},
    {"compiled", "import_options", "leftovers"},
    {"bit_planes", "disk", "estimators", "kernels", "large", "packing", "sources", "workers"},
    {"archive"},
    {"cluster", "document", "section", "plugins", "events", "image_files", "photos", "digits", "store", "tiles"},
    {"validated", "scene", "zipped", "by_value", "yaml_edit", "kinds"},
    {"effects", "readout", "remote", "images", "pictures", "positions", "window"},
    {"gather", "grids", "recording"},
    {"hooks", "reconstruct", "statistics", "capture_files"},
    {"gates", "line"},
    {"sensor"},
    {"lazy", "standing"},
    {"experiment", "signatures"},
    {"config"},
    {"identity", "manifest", "sensor_file"},
    {"shard_plan"},
    {"manifest_file", "shard_columns"},
    {"dataset"},
    {"golden", "measurement", "shard_facts"},
    {"factory", "look", "reference", "schema", "template", "twin"},
    {"inference"},
    {"plan", "verify", "report", "pages", "starting", "testing"},
    {"fetching", "importers"},
    {"exporters", "fluxes", "image_exporters", "torch"},
    {"library"},
    {"experiments"},
    {"cli"},
    {"start"},
    {"__main__"},
]
LEVEL = {name: level for level, layer in enumerate(LAYERS) for name in layer}
# the line of the paper has a kernel of its own, so the sensor knows the effects that it is made of
FUSED = {"afterpulsing", "dead_time", "tdc"}


def layer_of(file: str) -> str:
    return Path(file).parts[0].removesuffix(".py")


@functools.cache
def parsed(file: str) -> ast.Module:
    return ast.parse(MODULES[file].read_text())


@functools.cache
def imports(file: str, with_types: bool = False) -> list[tuple[int, str]]:
    """(line, dotted name) of all imports of a module, those within functions too, relative ones made absolute."""
    return list(_imports(file, with_types))


def _imports(file: str, with_types: bool) -> Iterator[tuple[int, str]]:
    tree = parsed(file)
    skipped = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test) and not with_types:
            skipped |= {id(inner) for inner in ast.walk(node)}
    package = ["spadmnist", *Path(file).parts[:-1]]
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        if isinstance(node, ast.Import):
            yield from ((node.lineno, name.name) for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            stem = ".".join([*base, *([node.module] if node.module else [])])
            yield from ((node.lineno, f"{stem}.{name.name}") for name in node.names)


def ours(name: str) -> str | None:
    """The layer's member that a dotted name lies in, or None where it is not ours."""
    parts = name.split(".")
    return parts[1] if parts[0] == "spadmnist" and len(parts) > 1 and parts[1] in LEVEL else None


def test_every_module_has_its_layer() -> None:
    assert {layer_of(f) for f in MODULES} - {"__init__"} == set(LEVEL)


@pytest.mark.parametrize("file", [f for f in MODULES if f != "__init__.py"])
def test_imports_go_downward(file: str) -> None:
    level = LEVEL[layer_of(file)]
    for line, name in imports(file):
        target = ours(name)
        if target is not None and target != layer_of(file):
            assert LEVEL[target] < level, f"{file}:{line} imports {name}, which is not below it"


def test_the_package_itself_imports_nothing_of_ours() -> None:
    assert [name for _, name in imports("__init__.py") if name.startswith("spadmnist")] == []


@pytest.mark.parametrize("file", [f for f in MODULES if re.fullmatch(r"effects/(?!__init__).*", f)])
def test_an_effect_can_be_read_alone(file: str) -> None:
    allowed = {"events", "plugins", "kernels", "units", "streams", "effects"}
    for line, name in imports(file, with_types=True):
        if name.startswith("spadmnist"):
            assert ours(name) in allowed, f"{file}:{line} imports {name}"
        else:
            assert name.split(".")[0] in {"__future__", "numpy", "math", "typing"}, f"{file}:{line} imports {name}"
    names = {n.removeprefix("spadmnist.effects.").split(".")[0] for _, n in imports(file) if ".effects." in n}
    # a law that several effects share stands in a module of its own, whose name begins with an underscore
    shared = {name for name in names if name.startswith("_") and f"effects/{name}.py" in MODULES}
    own = {name for name in names - shared if not (name[:1].isupper() or name == "parameter")}
    assert not own, "an effect imports no other effect"


@pytest.mark.parametrize(
    ("package", "owners"),
    [
        (
            "matplotlib",
            {
                *("report/_sheet.py", "pictures.py", "library/answers.py"),
                *(f"pages/{name}.py" for name in ("_figures", "_comparison", "_diagnosis", "_pixels")),
            },
        ),
        ("jinja2", {"pages/_frame.py"}),
        ("click", {file for file in MODULES if layer_of(file) == "cli"}),
        ("torch", {"torch.py", "experiments/_lenet.py"}),
        ("tqdm", {"cli/_terminal.py"}),
        ("pyarrow", {"image_exporters.py"}),
        ("yaml", {"document.py"}),
        ("loky", {"workers.py"}),
        ("cloudpickle", {"by_value.py"}),
        ("distributed", {"cluster.py"}),
        ("dask", {"cluster.py", "lazy.py"}),
        ("obstore", {"remote.py"}),
        ("xarray", {"lazy.py"}),
        ("h5py", {"capture_files.py", "store/hdf5.py", "importers/hdf5.py", "exporters.py"}),
        ("pooch", {"images.py", "image_files.py"}),
        (
            "pydantic",
            {
                *(
                    "validated.py",
                    "config/__init__.py",
                    "config/_sections.py",
                    "images.py",
                    "manifest.py",
                    "schema.py",
                    "section.py",
                ),
                "measurement/entries.py",
            },
        ),
    ],
)
def test_a_library_has_its_place(package: str, owners: set[str]) -> None:
    users = {f for f in MODULES for _, name in imports(f, with_types=True) if name.split(".")[0] == package}
    assert users <= owners


def _named(requirement: str) -> str:
    """The name of a distribution in a requirement, as names are compared."""
    return re.sub(r"[-_.]+", "-", re.split(r"[^\w.-]", requirement, maxsplit=1)[0]).lower()


def test_what_is_imported_is_declared_and_what_is_declared_is_imported() -> None:
    """A distribution that another one brings counts as declared only in a module that imports that other one."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    needed = {_named(r) for r in project["dependencies"]}
    extras = {_named(r) for name, some in project["optional-dependencies"].items() if name != "dev" for r in some}
    owners = {name: {_named(d) for d in some} for name, some in importlib.metadata.packages_distributions().items()}
    found: set[str] = set()
    for file in MODULES:
        tops = {name.split(".")[0] for _, name in imports(file)} - set(sys.stdlib_module_names) - {"spadmnist"}
        here = {top: owners[top] for top in tops & owners.keys()}  # what is not installed cannot be looked up
        declared = {d for some in here.values() for d in some & (needed | extras)}
        brought = {_named(r) for d in declared for r in importlib.metadata.requires(d) or [] if "extra ==" not in r}
        missing = {top for top, some in here.items() if not some & (declared | brought)}
        assert not missing, f"{file} imports {missing}, which pyproject.toml does not declare"
        found |= declared
    assert needed <= found, f"declared and never imported: {needed - found}"


def calls(file: str) -> Iterator[tuple[int, str]]:
    for node in ast.walk(parsed(file)):
        if isinstance(node, ast.Call):
            yield node.lineno, ast.unparse(node.func)
        elif isinstance(node, ast.Raise) and node.exc is not None:
            yield node.lineno, ast.unparse(node.exc).partition("(")[0]


@pytest.mark.parametrize("file", [f for f in MODULES if layer_of(f) != "cli"])
def test_only_the_command_line_prints_or_exits(file: str) -> None:
    talk = {"print", "input", "exit", "quit", "breakpoint", "sys.exit", "SystemExit", "warnings.warn"}
    for line, name in calls(file):
        assert name not in talk, f"{file}:{line} calls {name}"
        assert not name.startswith(("sys.stdout.write", "sys.stderr.write")), f"{file}:{line} calls {name}"


@pytest.mark.parametrize("file", [f for f in MODULES if layer_of(f) == "cli" and f != "cli/_terminal.py"])
def test_of_the_command_line_one_file_prints(file: str) -> None:
    talk = {"print", "input", "click.echo", "click.secho", "click.confirm", "click.prompt", "click.style"}
    for line, name in calls(file):
        assert name not in talk, f"{file}:{line} calls {name}"
        assert not name.startswith(("sys.stdout.write", "sys.stderr.write")), f"{file}:{line} calls {name}"


@pytest.mark.parametrize("file", list(MODULES))
def test_nothing_is_evaluated_and_no_global_random_state_is_used(file: str) -> None:
    for line, name in calls(file):
        assert name not in {"eval", "exec", "np.random.seed", "np.random.default_rng", "random.random"}, (
            f"{file}:{line}"
        )
        assert not re.fullmatch(r"np\.random\.[a-z_]+", name), f"{file}:{line} calls {name}"


@functools.cache
def own_effects() -> frozenset[str]:
    return frozenset(n for n in Effect.registry if Effect.registry.find(n).__module__.startswith("spadmnist."))


@pytest.mark.parametrize("file", list(MODULES))
def test_there_is_no_list_of_effects(file: str) -> None:
    """No module but its own names an effect, as text or as a class. A stage may have the name of an effect."""
    exempt = {Path(file).stem} | (FUSED if file == "sensor.py" else set())
    words = own_effects() - set(STAGES) - exempt
    tree = parsed(file)
    # what it comes after is the one thing that an effect may say of another
    places = [n.value for n in ast.walk(tree) if isinstance(n, ast.Assign) and ast.unparse(n.targets[0]) == "after"]
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and node not in places:
            assert node.value not in words, f"{file}:{node.lineno} says {node.value!r}"
    for line, name in imports(file):
        found = re.match(r"spadmnist\.effects\.([a-z_]+)\.", name + ".")
        assert not (found and found.group(1) in own_effects() - exempt - {"parameter"}), f"{file}:{line} imports {name}"


@pytest.mark.parametrize("file", list(MODULES))
def test_no_collection_holds_several_effects(file: str) -> None:
    """Also where they have the names of stages."""
    for node in ast.walk(parsed(file)):
        if isinstance(node, ast.Tuple | ast.List | ast.Set | ast.Dict):
            items = node.keys if isinstance(node, ast.Dict) else node.elts
            named = {i.value for i in items if isinstance(i, ast.Constant)} & own_effects()
            stages = {i.value for i in items if isinstance(i, ast.Constant)} & set(STAGES)
            assert len(named - stages) == 0 or file == "sensor.py", f"{file}:{node.lineno} lists {sorted(named)}"


@pytest.mark.parametrize("name", spadmnist.__all__)
def test_public_names_are_there_and_explained(name: str) -> None:
    assert name in dir(spadmnist)
    found = getattr(spadmnist, name)
    assert (found.__doc__ or "").strip() and found.__doc__.strip()[0].isupper()


def test_a_name_that_is_not_there() -> None:
    with pytest.raises(AttributeError, match="no_such_name"):
        spadmnist.no_such_name  # noqa: B018


def public(file: str) -> Iterator[ast.FunctionDef | ast.ClassDef]:
    for node in parsed(file).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            yield node


@pytest.mark.parametrize("file", list(MODULES))
def test_what_is_public_is_explained(file: str) -> None:
    tree = parsed(file)
    assert ast.get_docstring(tree), f"{file} has no docstring"
    for node in public(file):
        assert ast.get_docstring(node), f"{file}:{node.lineno} {node.name} has no docstring"


def project_files() -> list[Path]:
    """Every file that belongs to the project: what git tracks, and what it does not ignore."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    try:
        listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout")
    return [ROOT / name for name in listed if (ROOT / name).is_file()]


# with a letter in brackets, so that this file does not find itself
PATHS = r"/[w]ork\b|/[r]oot\b|/[h]ome/[a-z]|/[U]sers/[A-Za-z]"
HOSTS = r"[p]ypi\.|python[h]osted|[a]naconda\.|index-[u]rl|npm[j]s"


def test_no_file_names_a_machine_or_a_registry() -> None:
    found = []
    for path in project_files():
        try:
            text = path.read_text(encoding="utf-8")
        except UnicodeDecodeError:
            continue
        for number, line in enumerate(text.splitlines(), 1):
            if re.search(rf"(?<![\w.~}}])(?:{PATHS})|{HOSTS}", line):
                found.append(f"{path.relative_to(ROOT)}:{number}: {line.strip()[:100]}")
    assert not found, "\n".join(found)


def test_types_reach_those_who_import_the_package() -> None:
    """Without this file type checkers take everything here for untyped."""
    assert (PACKAGE / "py.typed").is_file()


@pytest.mark.parametrize("path", sorted((ROOT / "tests").rglob("*.py")), ids=lambda path: path.name)
def test_the_inference_is_tested_by_its_public_names(path: Path) -> None:
    """A private name may be renamed, split or removed; a test that speaks of one forbids it. Constants may be set."""
    tree, modules = ast.parse(path.read_text()), set[str]()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("spadmnist.inference"):
            private = [alias.name for alias in node.names if alias.name.startswith("_")]
            assert not private, f"{path.name}:{node.lineno}: {', '.join(private)}"
            modules |= {alias.asname or alias.name for alias in node.names if node.module == "spadmnist.inference"}
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in modules:
            assert not re.match("_[a-z]", node.attr), f"{path.name}:{node.lineno}: {node.value.id}.{node.attr}"
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            assert not re.fullmatch(r"spadmnist\.inference[\w.]*\._[a-z]\w*", node.value), f"{path.name}:{node.lineno}"


def test_the_contents_of_the_inference_are_its_modules() -> None:
    contents = ast.get_docstring(parsed("inference/__init__.py")) or ""
    named = [name for names in re.findall(r"^([a-z_, ]+?)  +\S", contents, re.MULTILINE) for name in names.split(", ")]
    assert len(named) > 40 and len(set(named)) == len(named), named
    missing = [name for name in named if f"inference/{name}.py" not in MODULES]
    assert not missing, f"inference/__init__.py names {missing}, which are no modules"


@pytest.mark.parametrize("file", sorted(f for f in MODULES if f.startswith("inference/")))
def test_the_search_asks_for_no_unit_and_no_stage(file: str) -> None:
    """What is special is declared: the kind of a parameter, what an effect acts on, what a likelihood describes."""
    for node in ast.walk(parsed(file)):
        if isinstance(node, ast.Compare):
            names = {side.attr for side in [node.left, *node.comparators] if isinstance(side, ast.Attribute)}
            told = any(isinstance(x, ast.Constant) for side in node.comparators for x in ast.walk(side))
            assert not (names & {"unit", "stage"} and told), f"{file}:{node.lineno}"


@functools.cache
def records() -> frozenset[str]:
    """The dataclasses and named tuples of the inference, by their names alone."""
    found = set()
    for file in MODULES:
        for node in ast.walk(parsed(file)) if file.startswith("inference/") else ():
            if isinstance(node, ast.ClassDef):
                above = [ast.unparse(one) for one in [*node.decorator_list, *node.bases]]
                if any(re.match(r"(dataclasses\.)?dataclass\b|(typing\.)?NamedTuple\b", one) for one in above):
                    found.add(node.name)
    return frozenset(found)


def built_by_place(file: str) -> Iterator[tuple[int, str]]:
    """(line, class) of the calls of a record of the inference with four or more arguments that have no name.

    What is unpacked into its place counts as two: (low, high).
    """
    inside = file.startswith("inference/")
    tree = parsed(file)
    classes = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    known = {}  # what a name stands for here: a record of the inference, or a module of it
    for node in classes if inside else ():
        known[node.name] = node.name
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and ((inside and node.level == 1) or "inference" in (node.module or "")):
            known |= {alias.asname or alias.name: alias.name for alias in node.names}
    itself = {id(inner): node.name for node in classes if inside for inner in ast.walk(node)}
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        name = ast.unparse(node.func)
        if name in {"cls", "type(self)"}:
            name = itself.get(id(node), "")
        head, _, last = name.rpartition(".")
        made = last if head in known else known.get(name, "")
        if made in records() and len(node.args) + sum(isinstance(x, ast.Starred) for x in node.args) >= 4:
            yield node.lineno, made


@pytest.mark.parametrize("file", list(MODULES))
def test_no_result_of_the_inference_is_built_by_place(file: str) -> None:
    """A field that is added or moved would go to the wrong place without a word."""
    found = [f"{file}:{line} {name}" for line, name in built_by_place(file)]
    assert not found, "four or more arguments without a name: " + ", ".join(found)


@pytest.mark.parametrize("entry", ["comparison", "model_selection", "named_fit"])
def test_what_a_verb_begins_with_can_be_imported_first(entry: str) -> None:
    """In a process of its own: in this one the modules are there, in an order that hides a circle."""
    done = subprocess.run([sys.executable, "-c", f"import spadmnist.inference.{entry}"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
