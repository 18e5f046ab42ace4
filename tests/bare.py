"""A system that lacks what Windows lacks, put in place of this one: `bare.PROGRAM` begins the program of a process.

Modules that Windows does not have cannot be imported, functions and flags of `os` and `signal` are gone, folders cannot
be opened, a file that was opened for reading alone is not synchronised, and no file is renamed over another one.
"""

from __future__ import annotations

PROGRAM = """
import errno, fcntl as _fcntl, os, shutil, signal, sys
import platformdirs, psutil  # which take what Linux has for granted where they believe themselves there

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name in ("fcntl", "resource", "pwd", "grp", "termios"):
            raise ImportError(f"no module named {name} on this system", name=name)

for _name in ("fcntl", "resource", "pwd", "grp", "termios"):
    sys.modules.pop(_name, None)
sys.meta_path.insert(0, Absent())

os.environ.setdefault("USERNAME", "somebody")
_open, _fsync, _rename = os.open, os.fsync, os.rename

def _opened(path, flags, mode=0o777, *, dir_fd=None):
    if dir_fd is not None:
        raise NotImplementedError("dir_fd is not known here")
    if os.path.isdir(path):
        raise PermissionError(errno.EACCES, "a folder cannot be opened", str(path))
    return _open(path, flags, mode)

def _synchronised(handle):
    number = handle if isinstance(handle, int) else handle.fileno()
    if _fcntl.fcntl(number, _fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
        raise OSError(errno.EBADF, "it cannot be written")
    _fsync(number)

def _renamed(source, target):
    if os.path.lexists(target):
        raise FileExistsError(errno.EEXIST, "it is there already", str(target))
    _rename(source, target)

os.open, os.fsync, os.rename = _opened, _synchronised, _renamed
os.supports_dir_fd, os.supports_fd = set(), set()
shutil._use_fd_functions = False  # as it finds where it is imported
for _name in (
    "O_DIRECTORY", "O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC", "getuid", "geteuid", "getgid", "getegid", "pread",
    "sysconf", "sched_getaffinity", "posix_fadvise", "killpg", "setsid", "getrusage", "mkfifo",
):
    if hasattr(os, _name):
        delattr(os, _name)
for _name in ("SIGKILL", "pthread_sigmask", "SIGHUP", "SIGALRM", "setitimer"):
    if hasattr(signal, _name):
        delattr(signal, _name)
"""
