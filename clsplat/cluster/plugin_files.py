"""Plug-ins that runs in other processes need too."""

from pathlib import Path

from clsplat import plugins


def plugin_files() -> list[Path]:
    """Return the files of the plug-ins that were loaded by path; those of packages are found again."""
    return [plugin.path for plugin in plugins.loaded() if not plugin.installed]
