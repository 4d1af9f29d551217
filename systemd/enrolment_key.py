"""The key with which a box signs the labels that it enrols. In: a folder. Out: commands that make
key and signer there, where they are missing (appliance/deployment/enrolment_key.py)."""

from __future__ import annotations

FOLDER = "/etc/palpate/enrolment"


def make(folder: str = FOLDER, user: str = "palpate", group: str = "palpate") -> str:
    """Commands for root: `key`, which `user` alone may read, and `signer`, root's, who is believed.

    Where only the signer is left, no other key is made: the labels that were enrolled before would
    not be believed any more.
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
  public=$(ssh-keygen -y -f key < /dev/null) || {{ echo '{folder}/key is damaged; take it away' >&2; exit 1; }}
  printf 'box namespaces="palpate-enrolment" %s\\n' "$(printf %s "$public" | cut -d ' ' -f 1,2)" > signer.new
  chmod 644 signer.new && sync -f signer.new && mv signer.new signer
fi
)"""
