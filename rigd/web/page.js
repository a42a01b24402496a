// page.js - the rig in a browser: what rigd tells by /events is shown, what people press goes to /api. CONTROL.md is the protocol.
"use strict";

const SILENCE_MS = 12000; // rigd says something every 5 s
const TAKES_SHOWN = 20, MESSAGES_KEPT = 60;
const SYMBOLS = { ready: "\u2713", off: "\u25cb", starting: "\u2026", opening: "\u2026", recovering: "!", quarantined: "\u2715" };
const ENDED = ["verified", "developed", "solved", "failed"]; // a take whose frames are all here that ever will be

const $ = id => document.getElementById(id);
let rig = null;           // `status`, but for its cameras
let takes = [];
let connected = false, pressed = false; // pressed: rigd has not answered yet
let head = null;          // where a panorama is
let source = null, heardAt = 0, version = "";
const cameras = new Map(); // name: { data, card }

function element(tag, text, className) {
    const e = document.createElement(tag);
    if (text !== undefined) e.textContent = text;
    if (className) e.className = className;
    return e;
}

function setText(e, text) { // screen readers repeat what is set again
    if (e.textContent !== text) e.textContent = text;
}

const megabytes = bytes => (bytes / 1e6).toFixed(1) + " MB";
const sentence = text => text ? text[0].toUpperCase() + text.slice(1) + (/[.!?]$/.test(text) ? "" : ".") : "";

// ---- asking ----------------------------------------------------------------------------------------------------------------------

// One request; its result, or an Error that people can read.
async function ask(request) {
    for (let turn = 0; ; turn++) {
        let answer;
        try {
            answer = await fetch("api", { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(request) });
        } catch (e) {
            throw new Error("rigd cannot be reached; the list of takes will tell what became of this");
        }
        if (answer.status === 503 && turn < 5) {
            await new Promise(go => setTimeout(go, 300 * (turn + 1)));
            continue;
        }
        if (!answer.ok) throw new Error((await answer.text()).trim());
        const message = await answer.json();
        if (!message.ok) throw new Error(message.error.text);
        return message.result;
    }
}

function showOutcome(text, bad) {
    $("outcome").className = bad ? "bad" : "good";
    setText($("outcome"), sentence(text));
}

// A button's request: what comes of it is shown below the large button.
async function press(request, done) {
    showOutcome("");
    try {
        const result = await ask(request);
        if (done) done(result);
    } catch (e) {
        showOutcome(e.message, true);
    }
    askTakes();
}

function showEnd(take) {
    showOutcome("take " + take.id + ": " + take.state + (take.reason ? ": " + take.reason : "") + (take.seconds ? " after " + take.seconds.toFixed(1) + " s" : ""), take.state === "failed");
}

async function capture(event, onButton = false) {
    event.preventDefault();
    if ($("capture").disabled) return;
    pressed = true;
    showButtons();
    const request = { do: "capture", name: $("name").value.trim() || "take" };
    if (onButton) request.on_button = true;
    if ($("leave-out").checked) request.without_missing = true;
    await press(request, showEnd);
    pressed = false;
    showButtons();
}

function preflight() {
    press({ do: "preflight" }, result => {
        $("preflight-result").hidden = false;
        const lines = result.findings.map(f => line(f.severity, f.camera, f.port, f.text));
        if (!lines.length) lines.push(element("li", "Nothing to complain about: every camera is fit.", "good"));
        $("findings").replaceChildren(...lines);
    });
}

// ---- what is shown ---------------------------------------------------------------------------------------------------------------

function line(severity, camera, port, text) {
    const li = element("li", undefined, severity);
    li.append(element("b", severity), " ", text.includes(camera) || !camera ? "" : camera + " (" + port + "): ", text);
    return li;
}

function say(body) {
    const li = line(body.severity, body.camera, body.port, body.text);
    li.prepend(element("span", new Date().toLocaleTimeString() + " ", "faint"));
    $("log").querySelector(".none")?.remove();
    $("log").prepend(li);
    while ($("log").children.length > MESSAGES_KEPT) $("log").lastChild.remove();
}

// Why the button cannot be pressed, or what pressing it would do; in words.
function showButtons() {
    const unfit = [...cameras.values()].map(c => c.data).filter(c => c.condition !== "ready");
    let why = "", free = false;
    if (!connected) why = "The connection to rigd is lost. Trying again; a take under way goes on without this page.";
    else if (!rig) why = "Asking rigd.";
    else if (rig.refusal) why = sentence(rig.refusal);
    else if (pressed) why = "Asked for; waiting for rigd.";
    else {
        free = true;
        why = "Ready: " + rig.n_ready + " of " + rig.n_cameras + " cameras." + (rig.button === "takes" ? " The button at the rig begins a take, too." : "");
        if (unfit.length) {
            const named = unfit.slice(0, 4).map(c => c.name + " (" + c.port + ") is " + c.condition + (c.note ? ": " + c.note : "")).join("; ");
            why = sentence(rig.n_ready + " of " + rig.n_cameras + " cameras are ready. " + named + (unfit.length > 4 ? "; and " + (unfit.length - 4) + " more" : "")) +
                ($("leave-out").checked ? " They are left out." : " Preflight stops the take unless they may be left out.");
        }
    }
    const busy = connected && rig && rig.busy;
    setText($("why"), why);
    $("capture").disabled = !free;
    $("arm").hidden = !rig || !rig.can_arm;
    $("arm").disabled = !free;
    $("preflight").disabled = !connected || !rig || busy;
    $("cancel").hidden = !busy;
    $("panorama").hidden = !rig || !rig.panorama_camera;
    $("panorama").disabled = !free;
    $("continue").hidden = !(busy && rig.prompt);
    for (const c of cameras.values()) for (const b of c.card.querySelectorAll("button")) b.disabled = !connected;
}

function showNow() {
    const take = rig && rig.take, busy = rig && rig.busy;
    $("now").hidden = !busy;
    if (!busy) return;
    let text = rig.state === "idle" ? "busy" : rig.state;
    if (take && rig.state !== "idle") {
        text = take.name + ": " + rig.state;
        if (head && head.take === take.id) {
            text += ", stop " + head.stop + " of " + head.n_stops + (head.frame ? ", exposure " + head.frame + " (" + head.exposure + " s)" : "") + (head.text ? ": " + head.text : "");
        } else if (["collecting", ...ENDED].includes(rig.state)) text += ", " + take.n_delivered + " of " + take.n_expected + " cameras, " + take.n_frames + " frames, " + megabytes(take.bytes);
    }
    setText($("state"), sentence(text));
    $("prompt").hidden = !rig.prompt;
    setText($("prompt"), rig.prompt || "");
    const turning = take && head && head.take === take.id;
    $("progress").max = turning ? head.n_stops : take && take.n_expected ? take.n_expected : 1;
    $("progress").value = turning ? head.stop - 1 : take ? take.n_delivered : 0;
}

// What is made of takes now: develop: 3 of 12; preview: waiting.
function showMaking() {
    const making = (rig.processing || []).filter(p => !p.settled);
    $("making").hidden = !making.length;
    $("making").replaceChildren(...making.map(p => {
        const steps = p.steps.filter(s => s.state !== "done");
        return element("li", p.take.split("_").slice(1).join("_") + ": " + steps.map(s => s.step + " " + s.state + (s.n > 1 ? " " + s.n_done + " of " + s.n : "") +
            (s.total ? ", " + s.stage + " " + Math.floor(100 * s.done / s.total) + " %" : "") + (s.text ? ": " + s.text : "")).join("; "));
    }));
}

function showRig(data) {
    const before = rig;
    rig = data;
    if (version && version !== rig.version) location.reload(); // another rigd has another page
    version = rig.version;
    setText($("rig"), rig.name);
    document.title = rig.name + ": " + (rig.busy ? rig.state : "rig");
    setText($("count"), rig.n_ready + " of " + rig.n_cameras + " ready" + (rig.n_quarantined ? ", " + rig.n_quarantined + " quarantined" : "") + "; trigger " + rig.trigger);
    showNow();
    showMaking();
    showButtons();
    if (!before || before.busy !== rig.busy || before.state !== rig.state) showPictures();
    if (before && before.busy && !rig.busy) askTakes();
}

function facts(c) {
    const f = [];
    if (c.battery_percent !== undefined) f.push("battery " + c.battery_percent + " %");
    if (c.free_images !== undefined) f.push(c.free_images + " free");
    if (c.card_present === 0) f.push("no card");
    if (c.lag_ms !== undefined) f.push("lag " + c.lag_ms.toFixed(2) + " ms");
    return f.join(", ") || "nothing known yet";
}

function newCard(name) {
    const card = element("li"), picture = element("img"), identify = element("button", "Identify"), reinstate = element("button", "Try again");
    picture.alt = "last frame of camera " + name;
    picture.hidden = true;
    picture.onload = () => { picture.hidden = false; };
    picture.onerror = () => { picture.hidden = true; delete picture.dataset.take; };
    identify.type = reinstate.type = "button";
    identify.setAttribute("aria-label", "Identify camera " + name);
    reinstate.setAttribute("aria-label", "Try camera " + name + " again");
    identify.onclick = () => press({ do: "identify", camera: name }, () => showOutcome("camera " + name + " shows itself"));
    reinstate.onclick = () => press({ do: "reinstate", camera: name });
    const buttons = element("p", undefined, "buttons");
    buttons.append(identify, reinstate);
    card.append(element("h3", name), element("p", "", "condition"), picture, element("p", "", "facts"), element("p", "", "port faint"), element("p", "", "note"), buttons);
    return card;
}

function showCamera(data) {
    let c = cameras.get(data.name);
    if (!c) {
        c = { card: newCard(data.name) };
        cameras.set(data.name, c);
        $("cameras").append(c.card);
    }
    c.data = data;
    const card = c.card, set = (name, text) => setText(card.querySelector("." + name), text);
    card.className = data.condition;
    card.dataset.camera = data.name;
    set("condition", (SYMBOLS[data.condition] || "?") + " " + data.condition + (data.doing ? ": " + data.doing + (data.bytes_now ? " " + megabytes(data.bytes_now) : "") : ""));
    set("facts", facts(data));
    set("port", (data.model ? data.model + ", " : "") + data.port);
    set("note", data.note || "");
    card.querySelectorAll("button")[1].hidden = data.condition !== "quarantined";
    if (data.doing === "fetch" && rig && rig.take && rig.take.kind !== "panorama") showPicture(c, rig.take.id); // a thumbnail comes before its raw
}

function showPicture(c, take) {
    const picture = c.card.querySelector("img");
    if (picture.dataset.take === take) return;
    picture.dataset.take = take;
    picture.src = "takes/" + take + "/thumbnails/" + c.data.name + ".jpg";
}

// The last take's, once it has ended; after a new start of rigd the newest there is.
function showPictures() {
    const take = rig && rig.take && rig.take.kind !== "panorama" ? rig.take : takes.find(t => t.kind !== "panorama");
    if (take && ENDED.includes(take.state)) for (const c of cameras.values()) showPicture(c, take.id);
}

// ---- takes -----------------------------------------------------------------------------------------------------------------------

function showTake(take) {
    const li = element("li"), missing = take.missing.map(m => m.camera + (m.note ? " (" + m.note + ")" : ""));
    li.dataset.take = take.id;
    li.append(element("h3", take.name), element("p", new Date(take.created).toLocaleString() + ", " + take.id, "faint"));
    const state = element("b", take.state, take.state === "failed" ? "bad" : "good");
    const figures = element("p");
    figures.append(state, ": " + take.n_delivered + " of " + take.n_expected + (take.kind === "panorama" ? " exposures, " : " cameras, ") + take.n_frames + " frames, " + megabytes(take.bytes) +
        (take.spread_ms !== undefined ? ", shutters within " + take.spread_ms.toFixed(2) + " ms" : ""));
    li.append(figures);
    if (take.reason) li.append(element("p", sentence(take.reason), "bad"));
    if (missing.length) li.append(element("p", "Missing: " + missing.join(", "), "bad"));
    if (take.left_out.length) li.append(element("p", "Left out: " + take.left_out.map(m => m.camera).join(", ")));
    for (const s of take.processing ? take.processing.solves : []) {
        li.append(element("p", s.name + " solve: " + (s.rmse_held_out_percent !== undefined ? "held-out error " + s.rmse_held_out_percent.toFixed(2) + " %, " : "") +
            (s.trusted ? "trusted" : "not to be trusted" + (s.why ? ": " + s.why : "")), s.trusted ? "" : "bad"));
    }
    for (const note of take.processing ? take.processing.notes : []) li.append(element("p", note, "bad"));
    for (const file of take.files) {
        const a = element("a", file.what + (file.path.startsWith("solve/") ? " (" + file.path.split("/")[1] + ")" : ""));
        a.href = "takes/" + take.id + "/" + file.path;
        a.target = "_blank";
        a.rel = "noopener";
        li.append(a);
    }
    if (take.kind !== "panorama" && take.n_delivered && !take.files.some(f => f.path.startsWith("solve/"))) {
        const preview = element("button", "Preview");
        preview.type = "button";
        preview.onclick = () => press({ do: "preview", take: take.id }, () => showOutcome("take " + take.id + " is being processed"));
        li.append(preview, " ");
    }
    if (missing.length) {
        const resume = element("button", "Fetch what is missing");
        resume.type = "button";
        resume.onclick = () => press({ do: "resume", take: take.id }, t => showOutcome("take " + t.id + ": " + t.state, t.state === "failed"));
        li.append(resume);
    }
    return li;
}

let askedTakes = 0;
async function askTakes() {
    const turn = ++askedTakes;
    try {
        const result = await ask({ do: "takes", newest: TAKES_SHOWN });
        if (turn !== askedTakes) return; // a later answer is under way
        takes = result.takes.reverse();
    } catch (e) {
        return; // the connection says it
    }
    $("takes").replaceChildren(...(takes.length ? takes.map(showTake) : [element("li", "none yet", "none")]));
    showPictures();
}

// ---- events ----------------------------------------------------------------------------------------------------------------------

function showConnection(is) {
    if (is === connected && $("connection").dataset.known) return;
    connected = is;
    $("connection").dataset.known = "yes";
    $("connection").className = is ? "" : "lost";
    setText($("connection"), is ? "connected" : "connection lost, trying again");
    document.body.classList.toggle("stale", !is);
    if (!is && $("count").textContent) setText($("count"), "as they were when the connection was lost");
    showButtons();
}

function showStatus(status) {
    cameras.clear();
    $("cameras").replaceChildren();
    rig = null;
    showConnection(true);
    status.cameras.forEach(showCamera);
    delete status.cameras;
    showRig(status);
    askTakes();
}

let takesDue = 0;
function take(message) {
    switch (message.event) {
    case undefined:
        if (message.id === "status" && message.ok) showStatus(message.result);
        return;
    case "alive":
    case "state": // "rig" says these too
    case "prompt":
    case "processing":
    case "progress":
        return;
    case "rig":
        showRig(message.body);
        return;
    case "cameras":
        message.body.cameras.forEach(showCamera);
        showButtons();
        return;
    case "panorama":
        head = message.body;
        showNow();
        return;
    case "say":
        say(message.body);
        return;
    case "lost": // this page was too slow: from the beginning
        connect();
        return;
    case "take":
        if (!pressed) showEnd(message.body); // somebody else's
        // and the list has changed: fall through
    default:
        clearTimeout(takesDue);
        takesDue = setTimeout(askTakes, 200);
    }
}

function connect() {
    source?.close();
    source = new EventSource("events");
    heardAt = Date.now();
    source.onmessage = event => {
        heardAt = Date.now();
        take(JSON.parse(event.data));
    };
    source.onerror = () => {
        showConnection(false);
        source.close();
        heardAt = 0;
    };
}

setInterval(() => {
    if (heardAt && Date.now() - heardAt > SILENCE_MS) {
        showConnection(false);
        heardAt = 0;
    }
    if (!heardAt) connect();
}, 1000);

$("capture-form").onsubmit = capture;
$("arm").onclick = event => capture(event, true);
$("leave-out").onchange = showButtons;
$("cancel").onclick = () => press({ do: "cancel" }, () => showOutcome("cancelled; frames that were exposed are fetched all the same"));
$("preflight").onclick = preflight;
$("panorama").onclick = () => press({ do: "panorama" }, showEnd);
$("continue").onclick = () => press({ do: "continue" });
connect();
