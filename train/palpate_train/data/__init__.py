"""Sweep sets: from files to arrays, checked, split and summed up."""
