"""A command: Hydra composes its settings, a model validates them, and a function does the work."""

from __future__ import annotations

import argparse
import logging
import os
import re
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import ConfigAttributeError, ConfigKeyError
from pydantic import BaseModel

from ba_torchrl.cli import PROGRAM, config_dir
from ba_torchrl.cli.errors import name_presets, plain_errors
from ba_torchrl.cli.help import describe
from ba_torchrl.core.config import expanded, parse, takes_path
from ba_torchrl.core.errors import ConfigError, UnknownNameError
from ba_torchrl.core.plugins import has_entry_points, load_plugins
from ba_torchrl.record.logging import limit_library_logs
from ba_torchrl.record.results import flat
from ba_torchrl.training import hydra_schema
from ba_torchrl.training.config import ExperimentConfig

LOG_FORMAT = "[%(asctime)s][%(name)s][%(levelname)s] - %(message)s"


@dataclass(frozen=True)
class Arguments:
    """The parts of a command line."""

    overrides: Sequence[str] = ()
    """In Hydra's grammar, such as ``env.obs_size=64``."""
    config_name: str | None = None
    """Of another configuration than the command's own."""
    config_dir: str | None = None
    """A further folder of configurations."""
    asks_for_help: bool = False

    @property
    def names(self) -> set[str]:
        """The settings that are given, such as ``env.obs_size``."""
        return {override.split("=")[0].lstrip("+~") for override in self.overrides}

    @property
    def fields(self) -> set[str]:
        """The same, with the fields of one that is given in braces, such as ``algorithm.init.name``
        for ``algorithm.init={name: bc}``; Hydra has read the settings."""
        parsed = OverridesParser.create().parse_overrides([*self.overrides])
        return self.names | flat({each.key_or_group: each.value() for each in parsed}).keys()


@dataclass(frozen=True)
class Command:
    """A command of the command line, or a recipe of its own."""

    main: Callable[[Any], None]
    """Does the work, with the validated settings."""
    settings: type[BaseModel]
    """Model of the settings. Without ``config``, its defaults are those of the command."""
    positional: str | None = None
    """Field that words without "=" set, or several, "kind name", each set by one word."""
    config: str | None = None
    """Name of the configuration file that is used unless ``--config-name`` is given."""
    variants: str = ""
    """Pattern of the names of other configuration files that the package has for this command."""
    parse: Callable[[dict[str, Any], Arguments], Any] | None = None
    """Returns what ``main`` gets; by default an instance of ``settings``."""
    check: Callable[[dict[str, Any]], object] | None = None
    """Of a command with a configuration: refuses wrong settings as far as this needs no torch."""

    @property
    def name(self) -> str:
        """The command's name, that of its module."""
        return self.main.__module__.split(".")[-1]

    @plain_errors
    def run(self, words: Sequence[str] | None = None) -> None:
        """Run the command; an error in its arguments is one line, and ends the process."""
        arguments = self.read(sys.argv[1:] if words is None else words)
        if self.config is None:
            load_plugins(hydra_schema.plugins_in(arguments.overrides))
        elif self._is_answered_early(arguments):
            return
        else:
            hydra_schema.register(arguments.overrides)
        with self.composed(arguments) as settings:  # an unknown name ends it here
            if arguments.asks_for_help:
                print(self._help(settings, with_choices=True))  # noqa: T201
                return
            logging.basicConfig(level=logging.INFO, format=LOG_FORMAT, stream=sys.stdout)
            limit_library_logs()
            self._apply(lambda values: self.main(self._parsed(values, arguments)), settings)

    def _parsed(self, values: dict[str, Any], arguments: Arguments) -> Any:
        if self.parse is None:
            return parse(self.settings, values, "settings")
        return self.parse(values, arguments)

    def _is_answered_early(self, arguments: Arguments) -> bool:
        """Refuse what is wrong, or print the help, without the import of torch, which takes
        seconds; return whether the command line is answered.

        Plugins and further folders can have other presets, so that the answer has to wait.
        """
        if arguments.config_dir or "plugins" in arguments.names or has_entry_points():
            return False
        hydra_schema.register_open(config_dir())
        groups = {name.split(".")[0] for name in arguments.names} & {*hydra_schema.GROUPS}
        with self.composed(arguments) as settings:
            if arguments.asks_for_help and not groups:
                print(self._help(settings, with_choices=False))  # noqa: T201
                return True
            if self.check is not None and not arguments.asks_for_help:
                self._apply(self.check, settings)
        return False

    def _help(self, settings: DictConfig, with_choices: bool) -> str:
        words = "".join(f" [{name.upper()}]" for name in (self.positional or "").split())
        usage = f"{self.name}{words} [FIELD=VALUE ...]"
        text = sys.modules[self.main.__module__].__doc__ or ""
        values = OmegaConf.to_container(settings)
        return describe(usage, text, self.settings, values, self.config_names(), with_choices)

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
        overrides = [self._readable(word) for word in rest if word not in bare]
        if bare:
            overrides += self._positional(bare, overrides)
        return Arguments(overrides, found.config_name, folder, found.help)

    def _is_bare(self, word: str) -> bool:
        """Whether a word is the value of a positional field, such as a path with "=" or "~"."""
        if self.config is not None:  # Hydra has groups, "a/b=c", and deletions, "~a"
            return "=" not in word and not word.startswith("~")
        name = word.split("=")[0].lstrip("+")
        is_setting = name.split(".")[0] in self.settings.model_fields
        return "=" not in word or "/" in name or (not is_setting and os.path.lexists(word))

    def _readable(self, override: str) -> str:
        """Return an override with quotes around a text that Hydra cannot read, or would read as
        something else than a path."""
        name, is_set, value = override.partition("=")
        if not is_set or value.startswith(("'", '"', "{", "${")) or value in ("", "null"):
            return override
        is_path = name in self._paths
        is_list = value.startswith("[") and value.endswith("]")
        if is_list and is_path and not _is_read(override):
            return f"{name}=[{','.join(_quoted(item.strip()) for item in value[1:-1].split(','))}]"
        is_text = not value.startswith("[") and (is_path or not _is_read(override))
        return f"{name}={_quoted(value)}" if is_text else override

    @property
    def _paths(self) -> set[str]:
        """The settings that are paths."""
        further = {} if self.config is None else ExperimentConfig.model_fields
        fields = {**further, **self.settings.model_fields}
        return {name for name, field in fields.items() if takes_path(field)}

    def _refuse(self, option: str, words: Sequence[str]) -> NoReturn:
        """Refuse an option; if it is the name of a setting, say how to write it."""
        name, _, value = option.lstrip("-").partition("=")
        name = name.replace("-", "_")
        settings, known = {*self.settings.model_fields}, ["--help"]
        if self.config is not None:
            groups = (folder.name for folder in config_dir().iterdir() if folder.is_dir())
            settings |= {*ExperimentConfig.model_fields, *groups}
            known += ["--config-name", "--config-dir"]
        if name.split(".")[0] not in settings:
            raise UnknownNameError("option", option, known)
        if not value:
            following = [*words[list(words).index(option) + 1 :], "-"][0]
            value = "VALUE" if following.startswith("-") or "=" in following else following
        raise ConfigError(f"unknown option {option!r}: write {shlex.join([f'{name}={value}'])}")

    def _positional(self, words: Sequence[str], overrides: Sequence[str]) -> list[str]:
        """Return the overrides of the positional fields by words without "="."""
        names = (self.positional or "").split()
        if not names or len(words) > len(names) > 1:
            raise ConfigError(f"{words[-1]!r} sets nothing; settings are FIELD=VALUE, see --help")
        for name in names[: len(words)]:
            if any(override.startswith(f"{name}=") for override in overrides):
                raise ConfigError(f"{name} is given twice")
        values = [_quoted(word) for word in words]
        if len(values) > len(names):
            values = [f"[{','.join(values)}]"]
        return [f"{name}={value}" for name, value in zip(names, values, strict=False)]

    @contextmanager
    def composed(self, arguments: Arguments) -> Iterator[DictConfig]:
        """Context with the settings, in which presets can be composed."""
        overrides, main_folder = list(arguments.overrides), config_dir()
        name = arguments.config_name or self.config or self._store_defaults()
        known = self.config_names(arguments.config_dir)
        if self.config is not None and name not in known:
            raise UnknownNameError("configuration", name, known)
        if arguments.config_dir is not None:
            other = Path(arguments.config_dir).resolve()
            if (other / f"{name}.yaml").exists():  # Hydra reads it before it knows further folders
                main_folder, other = other, main_folder
            overrides.append(f"hydra.searchpath=[{_quoted(f'file://{other}')}]")
        with initialize_config_dir(str(main_folder), version_base="1.3", job_name=self.name):
            try:
                settings = compose(name, overrides=overrides, return_hydra_config=True)
            except HydraException as error:
                raise _explained(error) from None
            except ValueError as error:  # a preset that is neither a name nor a list
                raise ConfigError(f"{error}; see --help") from None
            HydraConfig.instance().set_config(settings)
            with open_dict(settings):
                del settings["hydra"]
            try:
                yield settings
            finally:
                HydraConfig.instance().cfg = None

    def _store_defaults(self) -> str:
        """Make the model's defaults a configuration; return its name."""
        values = dict.fromkeys(self.settings.model_fields, "???")
        node = OmegaConf.create({**values, **hydra_schema.defaults_of(self.settings)})
        for name in node:
            if not OmegaConf.is_missing(node, name) and OmegaConf.is_dict(node[name]):
                OmegaConf.set_struct(node[name], False)  # its entries are checked by the model
        ConfigStore.instance().store(name=f"_{self.name}", node=node)
        return f"_{self.name}"

    @staticmethod
    def _apply(function: Callable[[dict[str, Any]], object], settings: DictConfig) -> None:
        """Call a function with the values of the settings; its errors name presets."""
        missing = sorted(name for name in settings if OmegaConf.is_missing(settings, name))
        if missing:
            raise ConfigError(f"{missing[0]} is missing; see --help")
        try:
            function(OmegaConf.to_container(settings, resolve=True, throw_on_missing=True))
        except ConfigError as error:
            name_presets(error, settings)
            raise


def _quoted(word: str) -> str:
    """Return a text in quotes; backslashes before a quote are doubled, as Hydra reads them."""
    return "'" + re.sub(r"(\\*)('|$)", lambda m: 2 * m[1] + m[2].replace("'", "\\'"), word) + "'"


def _is_read(override: str) -> bool:
    """Whether Hydra can read an override."""
    try:
        OverridesParser.create().parse_override(override)
    except HydraException:
        return False
    return True


def _explained(error: HydraException) -> ConfigError:
    """Return an error of Hydra, with the known names if it is about one that is unknown."""
    cause = error.__cause__
    first = (str(error) or repr(cause)).splitlines()[0]
    if isinstance(error, OverrideParseException):
        in_braces = re.search("{.*[~=]", error.override)
        hint = "; texts in braces with ~ or = need quotes" if in_braces else ""
        return ConfigError(f"cannot read {error.override!r}: {first}{hint}")
    if isinstance(error, MissingConfigException) and error.missing_cfg_file is not None:
        group, _, name = error.missing_cfg_file.rpartition("/")
        known = [option for option in error.options or () if option != "schema"]
        return UnknownNameError(group, name, known)
    if isinstance(cause, ConfigAttributeError | ConfigKeyError):
        node = cause.parent_node
        if known := [str(key) for key in node if key != "hydra"] if OmegaConf.is_dict(node) else []:
            return UnknownNameError("setting", cause.full_key, known)
    return ConfigError(first)
