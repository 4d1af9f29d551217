"""Many boxes, for `make deploy HOSTS=FILE BUNDLE=DIR` and `make install HOSTS=FILE`: copy this file
and change it.

It is an inventory of pyinfra: Python, in which each list is a group of boxes. A box is a name or an
address, as ssh knows it (~/.ssh/config is read), alone or with values for this box:

- ssh_hostname, ssh_user, ssh_port, ssh_key (a file): the connection. The user needs sudo without a
password.
- board: its board file, "rpi4" or "rpi5", for an install on a box that has no settings yet.
"""

cell_3 = [
    "left-arm.cell3.example",
    ("right-arm.cell3.example", {"board": "rpi4"}),
]

# A group, with values for all its boxes.
bench = (
    [
        ("bench-1", {"ssh_hostname": "192.0.2.21"}),
        ("bench-2", {"ssh_hostname": "192.0.2.22", "ssh_port": 2222}),
    ],
    {"ssh_user": "pi", "board": "rpi5"},
)
