"""The program's commands, each in a process of its own that need not import everything anew.

One process imports what commands need and divides for each of them: that takes a second or two less than a new
interpreter, and one command shares as little with the next. What is about the interpreter itself (its surroundings,
signals, closed streams) is tested with real ones.
"""

from __future__ import annotations

import functools
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import IO, Any

COMMAND = str(Path(sys.executable).with_name("spadmnist"))
_SECONDS = 120.0

_SERVER = """
import json, os, sys
import h5py, loky, numpy, scipy.special, scipy.stats, yaml, zarr
import spadmnist.cli, spadmnist.inference.model_selection, spadmnist.factory, spadmnist.verify
from spadmnist import kernels, packing

packing.row_sums(numpy.zeros(1), numpy.zeros(2, numpy.int64))  # what compiled code needs at first
for line in sys.stdin:
    asked = json.loads(line)
    child = os.fork()
    if not child:
        os.setsid()
        for number, name in enumerate((os.devnull, asked["out"], asked["err"])):
            os.dup2(os.open(name, os.O_RDWR), number)
        os.chdir(asked["folder"])
        os.environ.clear()
        os.environ.update(asked["surroundings"])
        sys.argv = asked["command"]
        spadmnist.cli.main()
    print(child, flush=True)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


@functools.cache
def _server() -> subprocess.Popen[bytes]:
    """It ends with this process, which closes its standard input."""
    return subprocess.Popen([sys.executable, "-c", _SERVER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0)


def run(*arguments: object, cwd: Path | None = None, timeout: float = _SECONDS) -> subprocess.CompletedProcess[str]:
    """`spadmnist ARGUMENTS`, with nothing on standard input."""
    server = _server()
    command = [COMMAND, *map(str, arguments)]
    with tempfile.NamedTemporaryFile() as out, tempfile.NamedTemporaryFile() as err:
        asked = {
            "command": command,
            "folder": os.fspath(cwd or Path.cwd()),
            "surroundings": dict(os.environ),
            "out": out.name,
            "err": err.name,
        }
        assert server.stdin is not None and server.stdout is not None
        server.stdin.write(json.dumps(asked).encode() + b"\n")
        child = int(_line(server.stdout, _SECONDS) or 0)
        status = _line(server.stdout, timeout) if child else None
        if not status:  # what it says later would be taken for the next command's
            server.kill()
            _server.cache_clear()
            assert child, "the process that divides has ended"
            os.killpg(child, signal.SIGKILL)
            raise subprocess.TimeoutExpired(command, timeout)
        return subprocess.CompletedProcess(command, int(status), _text(out), _text(err))


def run_anew(*arguments: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """`spadmnist ARGUMENTS` in a new interpreter; options: of `subprocess.run`."""
    options = {"timeout": _SECONDS, **options}
    return subprocess.run([COMMAND, *map(str, arguments)], capture_output=True, text=True, **options)


def _line(stream: IO[bytes], seconds: float) -> bytes | None:
    """None where there is none for so long."""
    ready, _, _ = select.select([stream], [], [], seconds)
    return stream.readline() if ready else None


def _text(file: Any) -> str:
    return str(Path(file.name).read_text())
