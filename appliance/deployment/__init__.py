"""Signed bundles: store, trial, roll back, shadow."""
