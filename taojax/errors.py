"""Everything this package raises on purpose; the command line prints each as one line."""


class TaojaxError(Exception):
    """Root of all deliberate errors."""


class InputError(TaojaxError):
    """A file or array does not meet its spec; the message names file, row and fix."""


class ConfigError(TaojaxError):
    """A setting is unknown or out of range."""


class UsageError(TaojaxError):
    """The command line asks for something that does not exist."""


class GateError(TaojaxError):
    """A measured figure is worse than its baseline allows."""


class MissingExtraError(TaojaxError):
    """An optional dependency is absent; the message names the pip command."""
