"""Commands that make the key with which a box signs its own lessons, and the file of its signer, if
they are missing (appliance/palpate/deployment/enrolment_key.py)."""

from __future__ import annotations

FOLDER = "/etc/palpate/enrolment"


def make(folder: str = FOLDER, user: str = "palpate", group: str = "palpate") -> str:
    """Commands for root that make `key`, readable only by `user`, and `signer`, owned by root.

    If only the signer is left, no other key is made, since the labels enrolled before would become
    invalid.
    """
    return f"""(
install -d -m 750 -g {group} {folder}
umask 077
cd {folder}
if [ ! -s key ] && [ ! -s signer ]; then
  rm -f key.new key.new.pub
  ssh-keygen -q -t ed25519 -N '' -C palpate-enrolment -f key.new
  chown {user} key.new && chmod 400 key.new && sync -f key.new && mv key.new key
  rm key.new.pub
fi
if [ -s key ] && [ ! -s signer ]; then
  public=$(ssh-keygen -y -f key < /dev/null) \\
    || {{ echo '{folder}/key is damaged; remove it' >&2; exit 1; }}
  printf 'box namespaces="palpate-enrolment,palpate-taught" %s\\n' \\
    "$(printf %s "$public" | cut -d ' ' -f 1,2)" > signer.new
  chmod 644 signer.new && sync -f signer.new && mv signer.new signer
fi
)"""
