"""What the command answers before its imports."""

import subprocess
import sys

STOPPED_AT_THE_IMPORT = """
import builtins, os, signal
import ewif_jax_command
true_import = builtins.__import__
def importing(name, *rest):
    if name.startswith("ewif_jax"):
        os.kill(os.getpid(), getattr(signal, "{signal}"))
    return true_import(name, *rest)
builtins.__import__ = importing
ewif_jax_command.main()
"""


def called(code, *arguments):
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, capture_output=True, text=True)


def test_no_such_file_needs_no_imports(tmp_path):
    code = (
        "import sys, ewif_jax_command\n"
        "try: ewif_jax_command.main()\n"
        "finally: print('ewif_jax' in sys.modules, 'jax' in sys.modules)"
    )
    done = called(code, "track", str(tmp_path / "none.csv"), "--tune")
    assert done.returncode == 2
    assert done.stderr == f"ewif-jax: {tmp_path / 'none.csv'}: no such file\n"
    assert done.stdout == "False False\n"


def test_a_signal_while_importing_is_no_traceback():
    for name, status in (("SIGINT", 130), ("SIGTERM", 143)):
        done = called(STOPPED_AT_THE_IMPORT.format(signal=name), "study", "sine")
        assert done.returncode == status
        assert done.stderr == "ewif-jax: stopped before it began\n"
