"""Runs chapters, saves figures and tables, keeps the scoreboard, builds the HTML book."""
