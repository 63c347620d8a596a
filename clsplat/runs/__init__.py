"""One run in its folder: start, resume, verify, status, render, live preview."""
