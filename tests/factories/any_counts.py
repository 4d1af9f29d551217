"""Raw counts of any type and any small grid, for properties that hold for all of them."""

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp


def any_counts(least: int, most: int) -> st.SearchStrategy[np.ndarray]:
    """Finite raw counts [T, R, C] of `least` to `most` frames."""
    return st.sampled_from(["uint8", "int16", "uint16", "float32"]).flatmap(
        lambda dtype: hnp.arrays(
            dtype,
            st.tuples(st.integers(least, most), st.integers(1, 3), st.integers(1, 3)),
            elements={"allow_nan": False, "allow_infinity": False} if dtype == "float32" else None,
        )
    )
