#!/bin/sh
# On the guest, as root: puts the box on a bare Debian as its manual says. $1: the folder with what to install.
set -eux
cd "$1"
/opt/palpate/bin/pip install -q --disable-pip-version-check --no-index --no-deps --force-reinstall palpate-*.whl
install -D -m 644 palpate.toml /etc/palpate/palpate.toml
install -D -m 644 -t /etc/palpate/skins firmware_config/skins/*.toml
install -m 644 systemd/palpate.service /etc/systemd/system/palpate.service
install -m 644 systemd/palpate.sysusers /usr/lib/sysusers.d/palpate.conf
install -m 644 systemd/palpate.tmpfiles /usr/lib/tmpfiles.d/palpate.conf
install -m 644 firmware_config/70-palpate.rules /etc/udev/rules.d/70-palpate.rules
# the robot's port by the place of its card, as ports are named by the order in which they are found
cat > /etc/udev/rules.d/71-rig.rules <<'RULE'
SUBSYSTEM=="tty", KERNELS=="0000:00:08.0", SYMLINK+="palpate-robot"
RULE
systemd-sysusers
systemd-tmpfiles --create palpate.conf
udevadm control --reload
udevadm trigger --settle
systemctl daemon-reload
systemctl enable palpate.service
systemctl start --no-block palpate.service
