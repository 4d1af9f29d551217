/* The events of the page's program: connects, and connects again by itself. */

const SILENT_MS = 3000, RETRY_MS = 1000, HIDDEN_MS = 10_000;

/* An object of the program without what every object of script has: a material may be called "constructor". */
function bare(name, value) { return value && typeof value === "object" && !Array.isArray(value) ? Object.setPrototypeOf(value, null) : value; }

/* heard: functions by the name of an event, called with its content. connection(there, answers): called where it changes;
   answers: whether there is a program at all, which then has no news. What was kept for newcomers is no news either. A tab that
   is hidden for HIDDEN_MS lets its stream go: a browser opens six connections to a box, for all of its tabs. */
export function listen(heard, connection) {
  let source = null, last = "", newsAt = performance.now(), state = "", waiting = 0, away = false;

  function connected(there, answers = there) {
    if (state === (state = `${there} ${answers}`)) return;
    connection(there, answers);
  }

  function open() {
    newsAt = performance.now();
    source = new EventSource(`events?last=${encodeURIComponent(last)}`);
    source.onerror = again;
    for (const [name, act] of Object.entries({begin() {}, now() {}, ...heard})) {
      source.addEventListener(name, (event) => {
        if (event.lastEventId) {
          last = event.lastEventId;
          newsAt = performance.now();
          connected(true);
        }
        act(JSON.parse(event.data, bare));
      });
    }
  }

  function again() {
    if (!source) return;
    connected(false, source.readyState === EventSource.OPEN);
    close();
    waiting = setTimeout(open, RETRY_MS);
  }

  function close() {
    if (source) source.close();
    source = null;
  }

  function seen() {
    clearTimeout(leaving);
    if (document.visibilityState === "hidden") {
      leaving = setTimeout(() => {
        away = true;
        clearTimeout(waiting);
        close();
      }, HIDDEN_MS);
    } else if (away) {
      away = false;
      open();
    }
  }

  let leaving = 0;
  document.addEventListener("visibilitychange", seen);
  setInterval(() => { if (performance.now() - newsAt > SILENT_MS) again(); }, 500);
  open();
}
