"""Readers of files with one recording, one module for each family of formats."""
