"""Signed bundles: signatures, store, trial, rollback and shadow mode."""
