"""What the page of `palpate watch --web` needs on the network. In: a folder. Out: commands that
make its token and certificate there, where they are missing."""

from __future__ import annotations

FOLDER = "/etc/palpate/watch"
DAYS, RENEWED_DAYS = 825, 60
"""How long a certificate holds: no longer than tablets accept. It is renewed by an install so long
before."""


def make(folder: str = FOLDER, group: str = "palpate-watch") -> str:
    """Commands for root: token, key.pem and certificate.pem, readable by root and `group`.

    The certificate is for this machine's host name, also as multicast DNS has it, for localhost,
    and for the addresses that the machine has now. It signs nothing but itself.
    """
    return f"""(
install -d -m 750 -g {group} {folder}
umask 077
put() {{ chgrp {group} {folder}/$1.new && chmod 640 {folder}/$1.new && sync -f {folder}/$1.new && mv {folder}/$1.new {folder}/$1; }}
if [ ! -s {folder}/token ]; then openssl rand -hex 16 > {folder}/token.new && put token; fi
if ! openssl x509 -checkend {RENEWED_DAYS * 86400} -noout -in {folder}/certificate.pem > /dev/null 2>&1; then
  name=$(hostname); names="DNS:$name,DNS:${{name%%.*}}.local,DNS:localhost,IP:127.0.0.1"
  for one in $(hostname -I 2> /dev/null || true); do names="$names,IP:$one"; done
  openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -sha256 -days {DAYS} -subj "/CN=palpate $name" \\
    -addext "subjectAltName=$names" -addext basicConstraints=critical,CA:FALSE -addext extendedKeyUsage=serverAuth \\
    -keyout {folder}/key.pem.new -out {folder}/certificate.pem.new 2> /dev/null
  put key.pem; put certificate.pem
fi
)"""
