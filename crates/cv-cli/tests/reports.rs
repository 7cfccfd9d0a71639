//! Reports in a browser: headless Chromium opens one of each kind, light and dark, as wide as a phone and as a screen.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

mod support;

use cv_core::{Camera, GrayF32};
use std::{
    fmt::Write as _,
    fs,
    io::Write as _,
    path::{Path, PathBuf},
    process::{Command, Stdio},
};
use support::{done, fixture, run};

/// Widths of a phone and of a screen, in CSS pixels.
const WIDTHS: [u32; 2] = [420, 1400];

/// What every framed page finds out about itself and tells the page around it, a while after it has loaded. The errors are those of its
/// scripts. Clicks go from the middle of the cloud outwards until one
/// meets a point.
const PROBE: &str = r#"<script>
const errors = [];
addEventListener("error", (e) => errors.push(e.message));
const told = console.error;
console.error = (...what) => { errors.push(what.join(" ")); told(...what); };
</script>"#;
const ASK: &str = r#"<script>
addEventListener("load", () => setTimeout(async () => {
  const frame = () => new Promise((done) => requestAnimationFrame(done));
  const clouds = [];
  for (const canvas of document.querySelectorAll(".cloud canvas")) {
    canvas.setPointerCapture = () => {};
    canvas.dispatchEvent(new KeyboardEvent("keydown", { key: "r" }));
    await frame();
    const copy = Object.assign(document.createElement("canvas"), { width: 160, height: 120 });
    const pen = copy.getContext("2d", { willReadFrequently: true });
    pen.drawImage(canvas, 0, 0, 160, 120);
    const pixels = pen.getImageData(0, 0, 160, 120).data, colors = new Set();
    for (let i = 0; i < pixels.length; i += 4) colors.add(pixels.slice(i, i + 3).join());
    const box = canvas.getBoundingClientRect(), words = canvas.parentElement.querySelector(".told");
    for (let n = 0; n < 400 && words.hidden; n++) {
      const away = Math.sqrt(n / 400) / 2, x = box.left + box.width * (0.5 + away * Math.cos(2.4 * n)), y = box.top + box.height * (0.5 + away * Math.sin(2.4 * n));
      for (const kind of ["pointerdown", "pointerup"]) {
        canvas.dispatchEvent(new PointerEvent(kind, { pointerId: 1, button: 0, clientX: x, clientY: y }));
      }
    }
    clouds.push({ colors: colors.size, told: words.textContent });
  }
  const style = (what) => getComputedStyle(document.querySelector(what));
  const bare = [...document.querySelectorAll("table")].filter((t) => !document.getElementById(t.getAttribute("aria-labelledby"))?.textContent.trim());
  const heads = [...document.querySelectorAll("thead th")].filter((th) => !th.textContent.trim());
  parent.postMessage({
    page: NAME, width: innerWidth, wide: document.documentElement.scrollWidth, errors, clouds, ground: style("body").backgroundColor,
    ink: document.querySelector("svg.plot text") ? getComputedStyle(document.querySelector("svg.plot text")).fill : "",
    broken: [...document.images].filter((i) => i.src && i.complete && i.naturalWidth === 0).length, bare: bare.length + heads.length,
  }, "*");
}, 100));
</script>"#;

/// The browser: `CHROMIUM`, or `chromium` on the path.
fn chromium() -> Option<PathBuf> {
    let given = std::env::var_os("CHROMIUM").map(PathBuf::from);
    let path = std::env::var_os("PATH").unwrap_or_default();
    given.or_else(|| std::env::split_paths(&path).map(|folder| folder.join("chromium")).find(|file| file.is_file()))
}

/// The page as text once all frames have answered, and what the browser complained about.
fn opened(browser: &Path, folder: &Path, page: &Path, dark: bool) -> (String, String) {
    let output = Command::new(browser)
        .args(["--headless", "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"])
        .args(["--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync"])
        .arg(format!("--user-data-dir={}", folder.join(if dark { "dark" } else { "light" }).display()))
        .arg(format!("--blink-settings=preferredColorScheme={}", if dark { 0 } else { 1 }))
        .args(["--window-size=1500,1000", "--virtual-time-budget=20000", "--enable-logging=stderr", "--dump-dom"])
        .arg(format!("file://{}", page.display()))
        .stdin(Stdio::null())
        .output()
        .unwrap();
    let [out, err] = [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned());
    (out, err)
}

/// Makes one report of each kind from the fixtures. Gives back their names.
fn make_reports(folder: &Path) -> Vec<&'static str> {
    let at = |name: &str| fixture(name).to_str().unwrap().to_owned();
    let [left, right] = ["stereo/left.jpg", "stereo/right.jpg"].map(at);
    let [a, b] = ["two-view/a.jpg", "two-view/b.jpg"].map(at);
    let [view0, view1] = ["panorama/view0.jpg", "panorama/view1.jpg"].map(at);
    let (images, masks) = (at("ball"), at("oracle/ball-masks"));
    let (width, height) = cv_io::read_rgb(fixture("stereo/left.jpg")).unwrap().size();
    let camera = Camera::from_focal(width, height, 380.0);
    let side = format!("{{width: {width}, height: {height}, fx: 380, fy: 380, cx: {}, cy: {}}}", camera.cx, camera.cy);
    let rig = format!(
        "schema: cv-rig/1\nunit: m\nleft: {side}\nright: {side}\nrotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\ntranslation: [-0.12, 0, 0]\n"
    );
    fs::write(folder.join("rig.yaml"), rig).unwrap();
    cv_io::pfm::write(folder.join("t.pfm"), GrayF32::from_fn(40, 30, |x, y| [(x + y) as f32 * 0.37]).view()).unwrap();
    let runs: [(&'static str, Vec<&str>); 9] = [
        (
            "depth",
            vec!["depth", &left, &right, "-o", "d.pfm", "--disparities", "64", "--focal", "380", "--baseline", "0.12"],
        ),
        ("eval", vec!["eval", "disparity", "--estimate", "t.pfm", "--truth", "t.pfm"]),
        ("rectify", vec!["rectify", &left, &right, "--rig", "rig.yaml", "--out", "rectified"]),
        ("reconstruct", vec!["reconstruct", &a, &b, "--focal", "440", "-o", "s.ply", "--dense", "n.ply"]),
        ("match", vec!["match", &a, &b, "-o", "m.txt"]),
        ("estimate", vec!["estimate", "fundamental", "--matches", "m.txt"]),
        ("panorama", vec!["panorama", &view0, &view1, "-o", "p.jpg"]),
        ("train", vec!["segment", "train", "--images", &images, "--masks", &masks, "--model", "ball.json"]),
        ("predict", vec!["segment", "predict", "--model", "ball.json", &images, "--out", "found"]),
    ];
    runs.map(|(name, args)| {
        done(folder, &[&args[..], &["--report", name]].concat());
        name
    })
    .to_vec()
}

/// The reports in frames, one over the other: a browser draws nothing in a frame that is out of sight.
fn framed(names: &[&str], widths: &[u32]) -> String {
    let mut frames = String::new();
    for (name, width) in names.iter().flat_map(|name| widths.iter().map(move |width| (name, width))) {
        let style = "position:fixed;left:0;top:0;border:0";
        let _ =
            write!(frames, "<iframe src=\"{name}.html\" width=\"{width}\" height=\"800\" style=\"{style}\"></iframe>");
    }
    frames
}

/// What the frames found out about themselves.
fn answers(dom: &str) -> Vec<serde_json::Value> {
    dom.lines()
        .filter_map(|line| line.strip_prefix("PAGE "))
        .map(|line| {
            let line = line.split("</pre>").next().unwrap();
            serde_json::from_str(&line.replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&")).unwrap()
        })
        .collect()
}

/// What must hold of every report at every width.
fn check(answer: &serde_json::Value) {
    assert!(answer["errors"].as_array().unwrap().is_empty(), "{answer}");
    assert!(answer["wide"].as_u64() <= answer["width"].as_u64(), "it scrolls sideways: {answer}");
    assert_eq!((answer["broken"].as_u64(), answer["bare"].as_u64()), (Some(0), Some(0)), "{answer}");
    let clouds = answer["clouds"].as_array().unwrap();
    let expected = match answer["page"].as_str().unwrap() {
        "reconstruct" => 2,
        "depth" => 1,
        _ => 0,
    };
    assert_eq!(clouds.len(), expected, "{answer}");
    for cloud in clouds {
        assert!(cloud["colors"].as_u64() > Some(20), "nothing is drawn: {answer}");
        assert_eq!(cloud["told"].as_str().unwrap().matches(": x ").count(), 2, "a click tells both pixels: {answer}");
    }
}

#[test]
fn reports_work_in_a_browser() {
    let Some(browser) = chromium() else {
        // Written past the test harness, which keeps what tests that pass print to itself.
        let words = "skipped: there is no Chromium (neither CHROMIUM nor chromium on the path): no report was opened";
        writeln!(std::io::stderr(), "{words}").unwrap();
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let names = make_reports(folder.path());
    for name in &names {
        let html = fs::read_to_string(folder.path().join(name).join("report.html")).unwrap();
        let asked = html.replacen("<head>", &format!("<head>{PROBE}"), 1).replacen(
            "</body>",
            &format!("{}</body>", ASK.replace("NAME", &format!("{name:?}"))),
            1,
        );
        fs::write(folder.path().join(format!("{name}.html")), asked).unwrap();
    }
    let mut seen = Vec::new();
    // The width has nothing to do with the colors: dark, the narrow one suffices.
    for (dark, widths) in [(false, &WIDTHS[..]), (true, &WIDTHS[..1])] {
        let frames = framed(&names, widths);
        let page = format!(
            "<!doctype html><meta name=\"color-scheme\" content=\"light dark\"><pre id=\"all\"></pre>{frames}<script>\
             addEventListener(\"message\", (e) => {{ document.getElementById(\"all\").textContent += \"\\nPAGE \" + JSON.stringify(e.data); }});</script>"
        );
        let around = folder.path().join("around.html");
        fs::write(&around, page).unwrap();
        let (dom, complaints) = opened(&browser, folder.path(), &around, dark);
        let answers = answers(&dom);
        assert_eq!(answers.len(), names.len() * widths.len(), "dark {dark}: {complaints}\n{answers:#?}");
        for answer in &answers {
            check(answer);
            let name = answer["page"].as_str().unwrap().to_owned();
            seen.push((name, dark, answer["ground"].clone(), answer["ink"].clone()));
        }
    }
    // Dark is dark, in the plots too: no color of the page's is the same in both.
    let (light, dark): (Vec<_>, Vec<_>) = seen.into_iter().partition(|(_, dark, ..)| !dark);
    for (name, _, ground, ink) in light {
        let other = dark.iter().find(|(n, ..)| *n == name).unwrap();
        assert!(ground != other.2 && (ink == "" || ink != other.3), "{name}: {ground} {ink} {other:?}");
    }
}

#[test]
fn a_report_begins_with_the_warnings_of_the_run_and_ends_with_how_it_was_called() {
    let folder = tempfile::tempdir().unwrap();
    // A third of the pair matches; the rest is noise that the other photograph does not confirm.
    let noise = |x: usize, y: usize, shift: usize| [(((x + shift) * 7919 + y * 104_729) % 251) as u8; 3];
    for (name, shift) in [("l.png", 0), ("r.png", 3)] {
        let photo = cv_core::RgbU8::from_fn(160, 90, |x, y| {
            if x < 60 { noise(x, y, shift) } else { noise(x * 31 + y, y * shift, shift) }
        });
        cv_io::write_png(folder.path().join(name), photo.view()).unwrap();
    }
    let ran =
        run(folder.path(), &["depth", "l.png", "r.png", "-o", "my map.pfm", "--disparities", "16", "--report", "out"]);
    assert_eq!(ran.code, Some(0), "{ran:?}");
    let html = fs::read_to_string(folder.path().join("out/report.html")).unwrap();
    let at = |text: &str| html.find(text).unwrap_or_else(|| panic!("{text} is missing"));
    let warned = ran.stderr.lines().find_map(|line| line.strip_prefix("warning: ")).unwrap();
    assert!(at(&warned[1..20]) < at("<main>"), "{warned}");
    assert!(at("cv depth l.png r.png -o &#39;my map.pfm&#39; --disparities 16 --report out") > at("Photographs</h2>"));
    assert!(at("--p1") > at("All options") && at(concat!("cv ", env!("CARGO_PKG_VERSION"))) > at("This run</h2>"));
}
