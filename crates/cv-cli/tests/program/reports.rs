//! Reports in a browser: headless Chromium opens one of each kind, light and dark, at the width of a phone and of a screen.

use crate::support::{done, fixture, run};
use cv_core::{Camera, GrayF32};
use serde_json::Value;
use std::{
    fs,
    io::{BufRead as _, BufReader, Read as _, Write as _},
    net::{TcpListener, TcpStream},
    path::{Path, PathBuf},
    process::{Command, Stdio},
    sync::mpsc::{Sender, channel},
    time::Duration,
};

/// Widths of a phone and of a screen, in CSS pixels.
const WIDTHS: [u32; 2] = [420, 1400];

/// Reports that are also tested in dark mode.
const DARK: [&str; 3] = ["depth", "reconstruct", "match"];

/// Script in each page that reports its layout and its script errors to the test after loading. It clicks from the center
/// of the cloud outwards until it hits a point.
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
  await fetch("/answer", { method: "POST", body: JSON.stringify({
    page: location.pathname.slice(1), width: innerWidth, wide: document.documentElement.scrollWidth, errors, clouds,
    ground: style("body").backgroundColor,
    ink: document.querySelector("svg.plot text") ? getComputedStyle(document.querySelector("svg.plot text")).fill : "",
    broken: [...document.images].filter((i) => i.src && i.complete && i.naturalWidth === 0).length, bare: bare.length + heads.length,
  }) });
  parent.next();
}, 20));
</script>"#;

/// Returns the browser: `CHROMIUM`, or `chromium` on the path.
fn chromium() -> Option<PathBuf> {
    let given = std::env::var_os("CHROMIUM").map(PathBuf::from);
    let path = std::env::var_os("PATH").unwrap_or_default();
    given.or_else(|| std::env::split_paths(&path).map(|folder| folder.join("chromium")).find(|file| file.is_file()))
}

/// Serves files of the folder to the browser, and forwards what it posts.
fn serve(mut stream: TcpStream, folder: &Path, answers: &Sender<Value>) -> Option<()> {
    let mut reader = BufReader::new(stream.try_clone().ok()?);
    let mut line = String::new();
    reader.read_line(&mut line).ok()?;
    let path = line.split(' ').nth(1)?.split('?').next()?.trim_start_matches('/').to_owned();
    let mut length = 0;
    loop {
        let mut header = String::new();
        reader.read_line(&mut header).ok()?;
        if let Some(value) = header.to_ascii_lowercase().strip_prefix("content-length:") {
            length = value.trim().parse().ok()?;
        }
        if header.trim().is_empty() {
            break;
        }
    }
    let mut body = vec![0; length];
    reader.read_exact(&mut body).ok()?;
    let text = if path == "answer" {
        answers.send(serde_json::from_slice(&body).ok()?).ok()?;
        Vec::new()
    } else {
        fs::read(folder.join(path).with_extension("html")).ok()?
    };
    let head = format!(
        "HTTP/1.1 200 OK\r\nContent-Type: text/html\r\nContent-Length: {}\r\nConnection: close\r\n\r\n",
        text.len()
    );
    stream.write_all(head.as_bytes()).ok()?;
    stream.write_all(&text).ok()
}

/// Opens `around` in the browser and waits for the given number of answers.
fn opened(browser: &Path, folder: &Path, dark: bool, count: usize) -> Vec<Value> {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    let (sender, receiver) = channel();
    let files = folder.to_owned();
    std::thread::spawn(move || {
        for stream in listener.incoming().flatten() {
            let (files, sender) = (files.clone(), sender.clone());
            std::thread::spawn(move || serve(stream, &files, &sender));
        }
    });
    let log = folder.join("browser.log");
    let mut child = Command::new(browser)
        .args(["--headless", "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"])
        .args(["--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync"])
        .arg(format!("--user-data-dir={}", folder.join(if dark { "dark" } else { "light" }).display()))
        .arg(format!("--blink-settings=preferredColorScheme={}", if dark { 0 } else { 1 }))
        .args(["--window-size=1500,1000", &format!("http://{address}/around-{dark}")])
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(fs::File::create(&log).unwrap())
        .spawn()
        .unwrap();
    // Half a minute without an answer is a failure; a slow machine still answers.
    let answers: Vec<Value> = (0..count).map_while(|_| receiver.recv_timeout(Duration::from_secs(30)).ok()).collect();
    let _ = child.kill();
    let _ = child.wait();
    assert_eq!(answers.len(), count, "{answers:#?}\n{}", fs::read_to_string(log).unwrap());
    answers
}

/// Writes one report of each kind from the fixtures; returns their names.
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

/// Returns a page that opens the reports in a frame, one after the other at each width.
fn around(names: &[&str], widths: &[u32]) -> String {
    let visits: Vec<(&str, u32)> =
        names.iter().flat_map(|name| widths.iter().map(move |width| (*name, *width))).collect();
    format!(
        "<!doctype html><meta name=\"color-scheme\" content=\"light dark\"><iframe height=\"800\" style=\"border:0\"></iframe><script>
        const frame = document.querySelector(\"iframe\"), visits = {};
        function next() {{
          const visit = visits.shift();
          if (visit) [frame.width, frame.src] = [visit[1], \"/\" + visit[0] + \"?\" + visit[1]];
        }}
        next();
        </script>",
        serde_json::to_string(&visits).unwrap()
    )
}

/// Properties of every report at every width.
fn check(answer: &Value) {
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
        // Printed directly, since the test harness captures the output of passing tests.
        let words = "skipped: there is no Chromium (neither CHROMIUM nor chromium on the path): no report was opened";
        writeln!(std::io::stderr(), "{words}").unwrap();
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let names = make_reports(folder.path());
    for name in &names {
        let html = fs::read_to_string(folder.path().join(name).join("report.html")).unwrap();
        let asked =
            html.replacen("<head>", &format!("<head>{PROBE}"), 1).replacen("</body>", &format!("{ASK}</body>"), 1);
        fs::write(folder.path().join(format!("{name}.html")), asked).unwrap();
    }
    // All pages share one style sheet: in dark mode, pages with clouds and plots at the narrow width suffice.
    let runs = [(false, &names[..], &WIDTHS[..]), (true, &DARK[..], &WIDTHS[..1])];
    let answers: Vec<(bool, Vec<Value>)> = std::thread::scope(|scope| {
        let (browser, folder) = (&browser, folder.path());
        let runs = runs.map(|(dark, names, widths)| {
            fs::write(folder.join(format!("around-{dark}.html")), around(names, widths)).unwrap();
            (dark, scope.spawn(move || opened(browser, folder, dark, names.len() * widths.len())))
        });
        runs.into_iter().map(|(dark, run)| (dark, run.join().unwrap())).collect()
    });
    answers.iter().flat_map(|(_, answers)| answers).for_each(check);
    // In dark mode every color of the page differs from light mode, plots included.
    for dark in &answers[1].1 {
        let light = answers[0].1.iter().find(|light| light["page"] == dark["page"]).unwrap();
        for color in ["ground", "ink"] {
            assert!(dark[color] != "" && dark[color] != light[color], "{color}: {light} {dark}");
        }
    }
}

#[test]
fn a_report_starts_with_the_warnings_and_ends_with_the_command_line() {
    let folder = tempfile::tempdir().unwrap();
    // A third of the pair matches; the rest is noise without correspondence in the other photograph.
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
