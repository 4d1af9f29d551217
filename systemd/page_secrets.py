"""Commands that make the tokens and the certificate for the network access of the page of `palpate
watch --web`, if they are missing."""

from __future__ import annotations

FOLDER = "/etc/palpate/watch"
DAYS, RENEWED_DAYS = 825, 60
"""Validity of a certificate, no longer than tablets accept; and the remaining days from which on an
install renews it."""


def make(folder: str = FOLDER, group: str = "palpate-watch") -> str:
    """Commands for root that make the token of each role, key.pem and certificate.pem, readable by
    root and `group`.

    The certificate is valid for this machine's host name, also in multicast DNS, for localhost, and
    for the present addresses of the machine. It signs nothing but itself.
    """
    return f"""(
install -d -m 750 -g {group} {folder}
umask 077
put() {{
  chgrp {group} {folder}/$1.new && chmod 640 {folder}/$1.new && sync -f {folder}/$1.new \\
    && mv {folder}/$1.new {folder}/$1
}}
for one in token-look token-operate token-teach; do
  if [ ! -s {folder}/$one ]; then openssl rand -hex 16 > {folder}/$one.new && put $one; fi
done
if ! openssl x509 -checkend {RENEWED_DAYS * 86400} -noout -in {folder}/certificate.pem \\
  > /dev/null 2>&1; then
  name=$(hostname); names="DNS:$name,DNS:${{name%%.*}}.local,DNS:localhost,IP:127.0.0.1"
  for one in $(hostname -I 2> /dev/null || true); do names="$names,IP:$one"; done
  openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -sha256 \\
    -days {DAYS} -subj "/CN=palpate $name" -addext "subjectAltName=$names" \\
    -addext basicConstraints=critical,CA:FALSE -addext extendedKeyUsage=serverAuth \\
    -keyout {folder}/key.pem.new -out {folder}/certificate.pem.new 2> /dev/null
  put key.pem; put certificate.pem
fi
)"""
