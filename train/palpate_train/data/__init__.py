"""Sweep sets: from files to arrays, checked, split, altered and summed up."""
