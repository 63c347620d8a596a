"""Serve a page that shows a run while it trains and is reachable only from this machine."""
