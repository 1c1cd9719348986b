"""A command: words and presets are settings, a model validates them, a function does the work."""

from __future__ import annotations

import argparse
import logging
import os
import re
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from yaml import ScalarEvent, YAMLError, parse as parse_yaml

from ba_torchrl.cli import PROGRAM, config_dir, no_collection
from ba_torchrl.cli.errors import plain_errors
from ba_torchrl.core.config import defaults_of, expanded, parse, takes_list, takes_text
from ba_torchrl.core.env_config import EnvConfig
from ba_torchrl.core.errors import ConfigError, UnknownNameError
from ba_torchrl.core.plugins import load_plugins
from ba_torchrl.record.logging import limit_library_logs
from ba_torchrl.record.results import flat

LOG_FORMAT = "[%(asctime)s][%(name)s][%(levelname)s] - %(message)s"
_OTHER_BASE = re.compile(r"[-+]?(0[0-7_]*[1-7][0-7_]*|\d[\d_]*(:[0-5]?\d)+(\.[\d_]*)?)")
"""Numbers that YAML 1.1 reads with base 8 or 60, such as 064 and 6:40."""
_NAME = re.compile(r"[^.\[\]\s]+(\.[^.\[\]\s]+|\[[^\[\]\s]+\])*")
"""Name of a setting: fields of fields, such as env.obs_size or env[obs_size]."""


@dataclass(frozen=True)
class Arguments:
    """The parts of a command line."""

    given: Mapping[str, Any] = field(default_factory=dict)
    """The settings."""
    presets: Sequence[str] = ()
    """Of a command with a configuration: choices of presets in Hydra's grammar."""
    config_name: str | None = None
    """Of another configuration than the command's own."""
    config_dir: str | None = None
    """A further folder of configurations."""
    asks_for_help: bool = False

    @property
    def names(self) -> set[str]:
        """The settings that are given, such as ``env.obs_size``."""
        return {*flat(self.given)}


@dataclass(frozen=True)
class Command:
    """A command of the command line, or a recipe of its own."""

    main: Callable[[Any], None]
    """Does the work, with the validated settings."""
    settings: type[BaseModel]
    """Model of the settings, whose defaults are those of the command."""
    positional: str | None = None
    """Field that words without "=" set, or several, "kind name", each set by one word."""
    config: str | None = None
    """Name of the configuration file that is used unless ``--config-name`` is given."""
    variants: str = ""
    """Pattern of the names of other configuration files that the package has for this command."""
    further: type[BaseModel] | None = None
    """Model whose fields can be set besides."""
    parse: Callable[[dict[str, Any], Arguments], Any] | None = None
    """Returns what ``main`` gets; by default an instance of ``settings``."""

    @property
    def name(self) -> str:
        """The command's name, that of its module."""
        return self.main.__module__.split(".")[-1]

    @property
    def fields(self) -> dict[str, FieldInfo]:
        """The fields that can be set."""
        further = {} if self.further is None else self.further.model_fields
        return {**further, **self.settings.model_fields}

    @plain_errors
    def run(self, words: Sequence[str] | None = None) -> None:
        """Run the command; an error in its arguments is one line, and ends the process."""
        arguments = self.read(sys.argv[1:] if words is None else words)
        plugins = arguments.given.get("plugins", ())
        load_plugins([plugins] if isinstance(plugins, str) else plugins)
        if arguments.asks_for_help:
            with no_collection():
                print(self._help(arguments))  # noqa: T201
            return
        with self.composed(arguments) as settings:
            logging.basicConfig(level=logging.INFO, format=LOG_FORMAT, stream=sys.stdout)
            limit_library_logs()
            self._run(arguments, settings)

    def _help(self, arguments: Arguments) -> str:
        from ba_torchrl.cli.help import describe

        words = "".join(f" [{name.upper()}]" for name in (self.positional or "").split())
        usage = f"{self.name}{words} [FIELD=VALUE ...]"
        text = sys.modules[self.main.__module__].__doc__ or ""
        with self.composed(arguments) as settings:
            values = OmegaConf.to_container(settings)
            return describe(usage, text, self.settings, values, self.config_names())

    def _run(self, arguments: Arguments, settings: DictConfig) -> None:
        self._check_names(settings)
        for name, info in self.fields.items():
            if OmegaConf.is_missing(settings, name) or (
                name in self.settings.model_fields and info.is_required() and name not in settings
            ):
                is_word = name in (self.positional or "").split()
                how = f"{PROGRAM} {self.name} {name.upper()}" if is_word else f"write {name}=..."
                raise ConfigError(f"{name} is missing: {how}; see --help")
        values = OmegaConf.to_container(settings, resolve=True, throw_on_missing=True)
        try:
            if self.parse is None:
                self.main(parse(self.settings, values, "settings"))
            else:
                self.main(self.parse(values, arguments))
        except ConfigError as error:
            if self.config is not None:
                from ba_torchrl.training.presets import name_presets

                name_presets(error, settings)
            raise

    def _nested(self) -> set[str]:
        """Return the names of the fields of the environment and of the parts that can be chosen."""
        from ba_torchrl.algorithms.config import ALGORITHMS, NETWORKS
        from ba_torchrl.training.collectors.config import COLLECTORS

        registries = {"algorithm": ALGORITHMS, "network": NETWORKS, "collector": COLLECTORS}
        models = {"env": [EnvConfig]}
        models |= {name: [*map(known.entry, known)] for name, known in registries.items()}
        return {
            each
            for name in models.keys() & self.fields
            for model in models[name]
            for each in flat({name: defaults_of(model)})
        }

    def config_names(self, further: str | None = None) -> list[str]:
        """Return the names that ``--config-name`` takes."""
        if self.config is None:
            return []
        files = [*config_dir().glob(f"{self.variants}.yaml")]
        files += [] if further is None else Path(further).glob("[!_]*.yaml")
        return sorted({self.config, *(file.stem for file in files)})

    def read(self, words: Sequence[str]) -> Arguments:
        """Return the parts of a command line."""
        parser = argparse.ArgumentParser(
            PROGRAM, add_help=False, exit_on_error=False, allow_abbrev=False
        )
        parser.add_argument("-h", "--help", action="store_true")
        parser.add_argument("-cn", "--config-name")
        parser.add_argument("-cd", "--config-dir")
        try:
            found, rest = parser.parse_known_args(words)
        except argparse.ArgumentError as error:
            raise ConfigError(str(error)) from None
        options = [word for word in rest if word.startswith("-")]
        if options:
            self._refuse(options[0], words)
        if self.config is None and (found.config_name or found.config_dir):
            raise ConfigError(f"{self.name} has no configuration files; set its fields")
        folder = None if found.config_dir is None else expanded(found.config_dir)
        if folder is not None and not Path(folder).is_dir():
            raise ConfigError(f"there is no folder {folder}")
        bare = [word for word in rest if self._is_bare(word)]
        settings = [word for word in rest if word not in bare]
        presets = [word for word in settings if self._is_preset(word, folder)]
        for word in presets:
            group, _, value = word.lstrip("+").partition("=")
            if f"{group}s" in self.fields:
                text = f"{self.name} takes a list of presets; write {group}s=[{value}]"
                raise ConfigError(f"{group}: {text}")
        given = OmegaConf.create()
        for word in settings:
            if word not in presets:
                self._set(given, word)
        if bare:
            given.update(self._positional(bare, given))
        values = OmegaConf.to_container(given)
        if not found.help:
            self._check_names(values)  # before presets are composed, which takes most of the time
        return Arguments(values, presets, found.config_name, folder, found.help)

    def _check_names(self, names: Iterable[str]) -> None:
        for name in names:
            if name not in self.fields:
                meant = sorted(each for each in self._nested() if each.endswith(f".{name}"))
                raise UnknownNameError("setting", name, [*self.fields, *meant])

    def _is_bare(self, word: str) -> bool:
        """Whether a word is the value of a positional field, such as a path with "=" or "~"."""
        if self.config is not None:  # Hydra has groups, "a/b=c", and deletions, "~a"
            return "=" not in word and not word.startswith("~")
        name = word.split("=")[0].lstrip("+")
        is_setting = name.split(".")[0] in self.fields
        return "=" not in word or "/" in name or (not is_setting and os.path.lexists(word))

    def _is_preset(self, word: str, further: str | None) -> bool:
        """Whether a word chooses a preset, or is another one of Hydra's."""
        if self.config is None:
            return False
        name, _, value = word.lstrip("+").partition("=")
        group = name.partition("@")[0]
        folders = [config_dir(), *([] if further is None else [Path(further)])]
        is_group = group.strip("./") == group != "" and any(
            (folder / group).is_dir() for folder in folders
        )
        is_choice = is_group and not value.startswith("{")  # which are fields of the group's choice
        return is_choice or group.startswith(("~", "hydra.", "hydra/"))

    def _set(self, given: DictConfig, word: str) -> None:
        """Set the field of a word such as ``env.obs_size=64``."""
        name, _, text = word.lstrip("+").partition("=")
        if not _NAME.fullmatch(name):
            raise ConfigError(f"cannot read {word!r}: a setting is written as in env.obs_size=64")
        field = re.split(r"[.\[]", name)[0]
        if field != name and field in self.fields and takes_list(self.fields[field]):
            raise ConfigError(f"{name}: {field} is a list, which is set as a whole: {field}=[...]")
        try:
            OmegaConf.update(given, name, self._value(name, text), force_add=True)
        except (YAMLError, OmegaConfBaseException, RecursionError) as error:
            reason = getattr(error, "problem", None) or str(error).splitlines()[0]
            raise ConfigError(f"cannot read {word!r}: {reason}") from None

    def _value(self, name: str, text: str) -> Any:
        """Return the value of a field, which is YAML. Of a field of texts, such as paths, one that
        is not in quotes may have any sign."""
        info = self.fields.get(name)
        if info is not None and takes_text(info):
            marks = ("'", '"', "[") if takes_list(info) else ("'", '"')
            if not text.startswith(marks) and text != "null":
                return text
        if not text:
            return text
        for event in parse_yaml(text):
            is_plain = isinstance(event, ScalarEvent) and event.implicit[0]
            if is_plain and _OTHER_BASE.fullmatch(event.value):
                raise ConfigError(
                    f"{name}: YAML does not read {event.value} as a decimal number; write it "
                    "without a zero in front and without colons, or in quotes"
                )
        return OmegaConf.to_container(OmegaConf.from_dotlist([f"value={text}"]))["value"]

    def _refuse(self, option: str, words: Sequence[str]) -> NoReturn:
        """Refuse an option; if it is the name of a setting, say how to write it."""
        name, _, value = option.lstrip("-").partition("=")
        name = name.replace("-", "_")
        settings, known = {*self.fields}, ["--help"]
        if self.config is not None:
            settings |= {folder.name for folder in config_dir().iterdir() if folder.is_dir()}
            known += ["--config-name", "--config-dir"]
        if name.split(".")[0] not in settings:
            raise UnknownNameError("option", option, known)
        if not value:
            following = [*words[list(words).index(option) + 1 :], "-"][0]
            value = "VALUE" if following.startswith("-") or "=" in following else following
        raise ConfigError(f"unknown option {option!r}: write {shlex.join([f'{name}={value}'])}")

    def _positional(self, words: Sequence[str], given: DictConfig) -> dict[str, Any]:
        """Return the positional fields that words without "=" set."""
        names = (self.positional or "").split()
        if not names or len(words) > len(names) > 1:
            setting = shlex.join([self._setting_of(words[-1])])
            raise ConfigError(f"{words[-1]!r} sets nothing; write {setting}, see --help")
        for name in names[: len(words)]:
            if name in given:
                raise ConfigError(f"{name} is given twice")
        if len(words) > len(names):
            if not takes_list(self.fields[names[0]]):
                raise ConfigError(f"{words[1]!r} is one word too many: {names[0]} is {words[0]!r}")
            return {names[0]: list(words)}
        return dict(zip(names, words, strict=False))

    def _setting_of(self, word: str) -> str:
        """Return the setting that a word without "=" was probably meant to be."""
        if "/" in word and "task" in self.fields:
            return f"task={word}"
        if word in self.fields:
            return f"{word}=VALUE"
        files = [] if self.config is None else config_dir().glob(f"*/{word}.yaml")
        return next((f"{file.parent.name}={word}" for file in files), "FIELD=VALUE")

    @contextmanager
    def composed(self, arguments: Arguments) -> Iterator[DictConfig]:
        """Context with the settings, in which presets can be composed."""
        env = {"env": {}} if "env" in self.fields else {}
        defaults = OmegaConf.create({**env, **defaults_of(self.settings)})
        if self.config is None:
            yield OmegaConf.merge(defaults, arguments.given)
            return
        from ba_torchrl.training import presets

        name = arguments.config_name or self.config
        known = self.config_names(arguments.config_dir)
        if name not in known:
            raise UnknownNameError("configuration", name, known)
        further = None if arguments.config_dir is None else Path(arguments.config_dir)
        read = presets.composed(config_dir(), name, arguments.presets, further, arguments.given)
        with read as settings:
            yield OmegaConf.merge(defaults, settings, arguments.given)
