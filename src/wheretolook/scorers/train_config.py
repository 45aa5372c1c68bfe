"""Options of the train command: those that all learners share, and a group for each learner's own."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, make_dataclass, replace
from typing import TYPE_CHECKING, Any

from wheretolook.scorers.registry import Method, learned, methods_named
from wheretolook.training.config import SharedConfig
from wheretolook.utils.errors import ConfigError


@dataclass(frozen=True)
class _NamedMethods(SharedConfig):
    methods: tuple[str, ...] = ("mlp-2d", "mlp-2d+z", "mlp-2d+3d", "set")

    def __post_init__(self) -> None:
        super().__post_init__()
        methods_named(self.methods, learned())

    def chosen(self) -> list[Method]:
        """Return the methods to train, in the order of the option."""
        return methods_named(self.methods, learned())

    def options_of(self, method: Method) -> Any:
        """Return the options of a method: those of its group, with its own `settings`."""
        assert method.learner is not None
        return replace(getattr(self, method.folder), **method.learner.settings)


def _train_config() -> type:
    """Make `SharedConfig` with a field for the options of each folder of learned methods."""
    groups: dict[str, type] = {}
    for method in learned().values():
        assert method.learner is not None
        config = method.learner.config
        if groups.setdefault(method.folder, config) is not config:
            fix = "Give all methods of a family the same class of options."
            raise ConfigError("methods of one family have different classes of options", value=method.folder, fix=fix)
    if reserved := {*groups} & {own.name for own in fields(_NamedMethods)}:
        raise ConfigError("a learned method has the name of an option", value=min(reserved), fix="Rename it.")
    own = [(name, config, field(default_factory=config)) for name, config in groups.items()]
    made = make_dataclass("TrainConfig", own, bases=(_NamedMethods,), frozen=True)
    made.__module__ = __name__  # so that training processes can unpickle it
    lines = [f"        {name}: {(config.__doc__ or name).partition(chr(10))[0]}" for name, config in groups.items()]
    shared = (SharedConfig.__doc__ or "").rstrip()
    made.__doc__ = "\n".join([shared, *lines, "    "])
    return made


if TYPE_CHECKING:

    class TrainConfig(_NamedMethods):
        """Options of the train command, made from the registered methods."""

        def __init__(self, **options: Any) -> None: ...

else:
    TrainConfig = _train_config()
