"""Serve a page that shows a run while it trains, to this machine only."""
