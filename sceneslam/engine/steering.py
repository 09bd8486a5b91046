"""Commands of an operator during a run, executed between two observations."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from pathlib import Path

from sceneslam.types.command import Command, Pause, SaveMap, SelectModule, SelectScene
from sceneslam.types.errors import text_of
from sceneslam.types.maps import HybridMap


@dataclass(frozen=True, slots=True, kw_only=True)
class _Saving:
    """A map that is being saved."""

    command: SaveMap
    saved: Future[None]


class Operator:
    """Executes commands; `note` receives the result of each as an event.

    `select` takes one of `scenes`, or "" for the detector's own votes. Maps are saved
    asynchronously by `executor`.
    """

    def __init__(
        self,
        scenes: Sequence[str],
        select: Callable[[str], None],
        table: Mapping[str, Sequence[str]],
        save: Callable[[HybridMap, Path], None],
        folder: Path,
        note: Callable[..., None],
        executor: Executor,
    ) -> None:
        self._scenes, self._choose, self._table = scenes, select, table
        self._save, self._folder, self._note = save, folder, note
        self._executor = executor
        self._saving: list[_Saving] = []
        self.is_paused = False

    def obey(self, command: Command, stamp_ns: int) -> None:
        """Execute a command, or report in an event why that is not possible."""
        if isinstance(command, SaveMap) and _is_name(command.name):
            folder = self._folder / "maps" / command.name
            saved = self._executor.submit(self._save, command.hybrid, folder)
            self._saving.append(_Saving(command=command, saved=saved))
            self.report(stamp_ns)
        else:
            self._tell(command, stamp_ns, self._carry_out(command))

    def report(self, stamp_ns: int) -> None:
        """Report the maps that have been saved since the last call."""
        while self._saving and self._saving[0].saved.done():
            saving = self._saving.pop(0)
            error = saving.saved.exception()
            self._tell(saving.command, stamp_ns, "" if error is None else text_of(error))

    def close(self, stamp_ns: int) -> None:
        """Wait for the maps that are being saved."""
        self._executor.shutdown()
        self.report(stamp_ns)

    def _tell(self, command: Command, stamp_ns: int, refusal: str) -> None:
        asked, what = type(command).__name__, _what(command)
        if refusal:
            self._note("command_refused", stamp_ns, command=asked, what=what, why=refusal)
        else:
            self._note("command", stamp_ns, command=asked, what=what)

    def _carry_out(self, command: Command) -> str:
        """Execute a command; return the reason if that is not possible, else ""."""
        match command:
            case Pause(is_paused=is_paused):
                self.is_paused = is_paused
            case SelectScene(scene=scene):
                return self._select(scene)
            case SelectModule(module=""):
                return self._select("")
            case SelectModule(module=module):
                scenes = [scene for scene, keys in self._table.items() if keys[0] == module]
                firsts = ", ".join(sorted({keys[0] for keys in self._table.values()}))
                return self._select(scenes[0]) if scenes else f"first of a scene are: {firsts}"
            case SaveMap():
                return "expected a name without slashes"
        return ""

    def _select(self, scene: str) -> str:
        if scene and scene not in self._scenes:
            return f"the detector's scenes are: {', '.join(self._scenes)}"
        self._choose(scene)
        return ""


def _is_name(name: str) -> bool:
    return bool(name) and Path(name).name == name and not name.startswith(".")


def _what(command: Command) -> str:
    match command:
        case Pause(is_paused=is_paused):
            return "on" if is_paused else "off"
        case SelectScene(scene=what) | SelectModule(module=what) | SaveMap(name=what):
            return what
