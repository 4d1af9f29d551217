"""Experiments with the methods, and the pages and figures that publish their results.

`python -m palpate_studies` runs them. They may use all of `train`; nothing uses them.
"""
