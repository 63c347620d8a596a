"""The viewer page, charts and videos."""
