"""Start, resume, verify, report, render, and preview a single run in its folder."""
