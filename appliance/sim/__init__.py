"""The simulated world: tubes, finger and skin (`skin`), and the rig that puts them under the real drivers (`rig`)."""
