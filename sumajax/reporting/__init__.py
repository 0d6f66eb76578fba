"""What a run shows: metrics files, learning curves, replays and progress; imported only when used.

`metrics` needs numpy alone; the rest needs the extra `experiments` (matplotlib, pillow, rich), so
its names are resolved when they are first asked for.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sumajax.reporting.curves import learning_curves
    from sumajax.reporting.metrics import (
        append_rows,
        comparison,
        read_metrics,
        rows_of,
        truncate_after,
        write_json,
        write_text,
    )
    from sumajax.reporting.progress import Progress, print_table, result_table
    from sumajax.reporting.replay import Episode, record_episode, write_gif, write_strip

__all__ = [
    "Episode",
    "Progress",
    "append_rows",
    "comparison",
    "learning_curves",
    "print_table",
    "read_metrics",
    "record_episode",
    "result_table",
    "rows_of",
    "truncate_after",
    "write_gif",
    "write_json",
    "write_strip",
    "write_text",
]

_MODULES = {
    "curves": ("learning_curves",),
    "progress": ("Progress", "print_table", "result_table"),
    "replay": ("Episode", "record_episode", "write_gif", "write_strip"),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = import_module(f"{__name__}.{_HOME.get(name, 'metrics')}")
    return getattr(home, name)
