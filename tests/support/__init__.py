"""Helpers for tests and their authors."""
