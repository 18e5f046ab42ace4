"""A dataset in parts: any order, again, killed, at once, and then the same seal."""

from __future__ import annotations

import contextlib
import random
import signal
import threading
import time
from pathlib import Path

import pytest
from commands import run
from test_factory import SLOW, assert_same, assert_sentence, make, running, tree, wait_for, write_config

from spadmnist import config, factory, shard_plan
from spadmnist.errors import InputError, SpadError
from spadmnist.factory import Part


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """(config, dataset made at once)."""
    home = tmp_path_factory.mktemp("whole")
    make(write_config(home / "c.yaml"), home / "out")
    return home / "c.yaml", home / "out"


def one(file: Path, root: Path, part: str) -> factory.Outcome:
    experiment = config.read(file)
    return factory.generate(experiment, experiment.load_images(), root, 1, part=Part.parse(part))


def test_parts_in_any_order_and_twice_make_the_same_bytes(whole: tuple[Path, Path], tmp_path: Path) -> None:
    """And there are more parts than shards; what no part has made is made at the end."""
    file, root = whole[0], tmp_path / "out"
    total = len(shard_plan.shards_of(config.read(file), config.read(file).load_images()))
    order = random.Random(1).sample(range(1, 17), 16)
    left_out = min(total, 3)
    made = {k: one(file, root, f"{k}/16").made for k in order if k != left_out}
    assert sum(made.values()) == total - 1 and max(made.values()) == 1
    assert not (root / "manifest.json").exists()
    again = one(file, root, f"{total}/16")
    assert (again.made, again.kept, again.manifest) == (0, 1, {})
    outcome = make(file, root)
    assert (outcome.made, outcome.kept) == (1, total - 1)
    assert_same(root, tree(whole[1]))
    assert one(file, root, "1/16").manifest["sha256"], "it is complete already"


def test_parts_of_other_numbers_overlap_without_harm(whole: tuple[Path, Path], tmp_path: Path) -> None:
    for part in ("1/2", "2/3", "1/1"):
        one(whole[0], tmp_path / "out", part)
    make(whole[0], tmp_path / "out")
    assert_same(tmp_path / "out", tree(whole[1]))


def test_what_was_changed_between_the_parts_and_the_end_is_made_again(whole: tuple[Path, Path], tmp_path: Path) -> None:
    root = tmp_path / "out"
    one(whole[0], root, "1/1")
    shard = sorted(path for path in (root / "data").rglob("0*") if path.is_file())[0]
    content = bytearray(shard.read_bytes())
    content[len(content) // 2] ^= 1
    shard.write_bytes(content)
    assert make(whole[0], root).made == 1
    assert_same(root, tree(whole[1]))


def test_a_part_waits_for_one_that_leaves(tmp_path: Path) -> None:
    """The last part holds the dataset alone for a moment, and finds out that it is not the last."""
    root, held = tmp_path / "out", threading.Event()

    def leave() -> None:
        with factory.locked(root):
            held.set()
            time.sleep(0.2)

    leaving = threading.Thread(target=leave)
    leaving.start()
    assert held.wait(10)
    with factory.locked(root, Part(1, 2)):
        leaving.join()
        assert root.is_dir()


def test_parts_that_hold_their_locks(whole: tuple[Path, Path], tmp_path: Path) -> None:
    """Beside a part another one is made, not the same one, and not the whole."""
    root = tmp_path / "out"
    with factory.locked(root, Part(1, 2)):
        assert one(whole[0], root, "2/2").made > 0
        with pytest.raises(SpadError, match=r"another run is making part 1/2"):
            one(whole[0], root, "1/2")
        with pytest.raises(SpadError, match=r"another run is writing there"):
            make(whole[0], root)
    with factory.locked(root), pytest.raises(SpadError, match=r"another run is writing there"):
        one(whole[0], root, "1/2")
    make(whole[0], root)
    assert_same(root, tree(whole[1]))


def test_a_part_of_another_dataset_is_refused(whole: tuple[Path, Path], tmp_path: Path) -> None:
    one(whole[0], tmp_path / "out", "1/2")
    other = write_config(tmp_path / "other.yaml", train=41)
    with pytest.raises(SpadError, match=r"holds another dataset"):
        one(other, tmp_path / "out", "2/2")


def test_a_part_that_makes_nothing_leaves_nothing(tmp_path: Path, whole: tuple[Path, Path]) -> None:
    one(whole[0], tmp_path / "out", "16/16")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("text", ["", "0/4", "5/4", "1", "1/0", "a/b", "-1/4", "1/4/5", "1.0/4", "1/9999999999"])
def test_what_is_no_part(text: str) -> None:
    with pytest.raises(InputError, match=r"is no part; write K/N with K from 1 to N"):
        Part.parse(text)


def test_the_command_line(whole: tuple[Path, Path], tmp_path: Path) -> None:
    root = tmp_path / "out"
    assert_sentence(run("generate", whole[0], "-o", root, "--part", "3/2"), "--part 3/2: is no part")
    assert not root.exists()
    result = run("generate", whole[0], "-o", root, "--jobs", 1, "--part", "1/2")
    assert result.returncode == 0 and "Part 1/2: made" in result.stderr and not result.stdout, result.stderr


@pytest.mark.slow
def test_sixteen_parts_two_at_once_and_three_of_them_killed(tmp_path: Path) -> None:
    (tmp_path / "slow.py").write_text(SLOW)
    levels = ("5 mlux", "10 mlux", "40 mlux", "160 mlux", "320 mlux", "640 mlux", "1280 mlux")
    file, root = write_config(tmp_path / "c.yaml", levels=levels, more="    slow: {}\n"), tmp_path / "out"
    command = ("generate", file, "-o", root, "--jobs", 1, "--plugin", tmp_path / "slow.py")
    order, killed = random.Random(3).sample(range(1, 17), 16), 0
    while order:
        pair, order = order[:2], order[2:]
        with contextlib.ExitStack() as open_ones:
            parts = [open_ones.enter_context(running(*command, "--part", f"{k}/16")) for k in pair]
            if killed < 3:
                held = root / ".spadmnist" / f"part-{pair[0]}-of-16"
                assert wait_for(held.exists, 60)
                parts[0].send_signal(signal.SIGKILL)
                assert parts.pop(0).wait(10) == -signal.SIGKILL
                order.append(pair[0])
                killed += 1
            for process in parts:
                assert process.wait(120) == 0, process.stderr.read()
    assert killed == 3
    result = run(*command)
    assert result.returncode == 0, result.stderr
    expected = run("generate", file, "-o", tmp_path / "expected", "--jobs", 2, "--plugin", tmp_path / "slow.py")
    assert expected.returncode == 0, expected.stderr
    assert_same(root, tree(tmp_path / "expected"))
