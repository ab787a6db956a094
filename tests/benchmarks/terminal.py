"""What a terminal shows of a program's output: as much of one as the programs here make use of."""

import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import termios
from pathlib import Path

ROOT = Path(__file__).parents[2]
_CODES = re.compile(r"\x1b\[(\??[0-9;]*)([A-Za-z])|([\r\n])|([^\x1b\r\n]+)|(\x1b)")


class Screen:
    """
    :param rows: of the terminal
    :param columns: of the terminal
    """

    def __init__(self, rows, columns):
        self.columns = columns
        self.lines = [""] * rows
        self._row = self._column = 0

    def write(self, text):
        """Codes that it does not know are an error."""
        for number, code, control, printed, unknown in _CODES.findall(text):
            assert not unknown, "an escape that a terminal of this test does not know"
            if control == "\r":
                self._column = 0
            elif control == "\n":
                self._down()
            elif code == "A":
                self._row = max(self._row - int(number or 1), 0)
            elif code == "K":
                assert number == "2"
                self.lines[self._row] = ""
            elif code:
                assert code in "mhl", code
            for character in printed:
                self._put(character)

    def _put(self, character):
        if self._column == self.columns:  # a terminal wraps what is too wide
            self._column = 0
            self._down()
        line = self.lines[self._row].ljust(self._column)
        self.lines[self._row] = line[: self._column] + character + line[self._column + 1 :]
        self._column += 1

    def _down(self):
        if self._row == len(self.lines) - 1:
            self.lines = [*self.lines[1:], ""]
        else:
            self._row += 1


def output_in_terminal(program, rows, columns):
    """
    :param program: Python code, which finds the tests
    :param rows: of a real pseudo-terminal, its standard output
    :param columns: of it
    :return: all that it writes there
    """
    ours, its = pty.openpty()
    fcntl.ioctl(its, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]), "TERM": "xterm"}
    env = {name: value for name, value in env.items() if name not in ("LINES", "COLUMNS", "NO_COLOR", "FORCE_COLOR")}
    process = subprocess.Popen([sys.executable, "-c", program], stdin=its, stdout=its, stderr=its, cwd=ROOT, env=env)
    os.close(its)
    written = b""
    while True:
        try:
            read = os.read(ours, 65536)
        except OSError:  # all that had it open have closed it
            break
        if not read:
            break
        written += read
    os.close(ours)
    assert process.wait() == 0, written.decode()
    return written.decode()
