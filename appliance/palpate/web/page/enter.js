/* Asks for the token, or takes it from the address behind "#", which a browser sends to nobody. */

const field = document.getElementById("token"), said = document.getElementById("said");

async function enter(token) {
  if (!/^[A-Za-z0-9]+$/.test(token)) {
    said.textContent = "a token is letters and digits";
    return;
  }
  said.textContent = "asking the box";
  try {
    const answer = await fetch("enter", {headers: {Authorization: `Bearer ${token}`}});
    if (answer.ok) return location.replace(".");
    said.textContent = answer.status === 401 ? "this is not the token" : `the box answers ${answer.status}`;
  } catch {
    said.textContent = "no connection";
  }
  field.focus();
}

document.getElementById("go").addEventListener("click", () => enter(field.value.trim()));
field.addEventListener("keydown", (event) => { if (event.key === "Enter") enter(field.value.trim()); });
const given = location.hash.slice(1);
if (given.length >= 16) { // a shorter one is a view
  history.replaceState(null, "", location.pathname);
  enter(given);
}
field.focus();
