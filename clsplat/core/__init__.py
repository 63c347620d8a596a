"""Errors, files, locks, signals, settings, schedules, terminal output, and HTML pages, used by every other package."""
