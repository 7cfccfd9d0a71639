//! Pairing of the frames of several cameras.

use crate::frame::Failure;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// How frames are paired.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::commands) enum PairBy {
    Name,
    Number,
    Order,
}

cv_core::named!(PairBy {
    Name = "name": "frames of the same file name, without its ending",
    Number = "number": "frames whose names have the same last number: left_0007 and right_0007",
    Order = "order": "by position in the sorted list, regardless of names",
});

/// Pairs frames, in the order of the left ones. Without `by`, pairs them by name if the names are the same, else by number.
/// Unpaired frames are refused: frames of different moments would give plausible but wrong disparities.
pub(in crate::commands) fn pair(
    lefts: &[PathBuf],
    rights: &[PathBuf],
    by: Option<PairBy>,
) -> Result<Vec<(PathBuf, PathBuf)>, Failure> {
    match by {
        Some(PairBy::Order) => in_order(lefts, rights),
        Some(PairBy::Name) => by_key(lefts, rights, "name", name),
        Some(PairBy::Number) => by_key(lefts, rights, "number", number),
        None => {
            let named = by_key(lefts, rights, "name", name);
            // Without numbers, the error about names is the more helpful one.
            named.or_else(|reason| {
                let numbered = lefts.iter().chain(rights).all(|frame| number(frame).is_some());
                if numbered { by_key(lefts, rights, "number", number) } else { Err(reason) }
            })
        }
    }
}

/// The simultaneous frames, by camera.
pub(in crate::commands) type Moment = Vec<Option<PathBuf>>;

/// As [`pair`], for any number of cameras; unpaired frames are kept. Moments are in the order of the first camera, then the remaining ones of the second, and so
/// on.
pub(in crate::commands) fn join(cameras: &[Vec<PathBuf>], by: Option<PairBy>) -> Result<Vec<Moment>, Failure> {
    let shared = |key: &dyn Fn(&Path) -> Option<String>| -> Option<Vec<Moment>> {
        let keys = |frames: &Vec<PathBuf>| -> Option<BTreeMap<String, PathBuf>> {
            let found: BTreeMap<String, PathBuf> =
                frames.iter().map(|f| Some((key(f)?, f.clone()))).collect::<Option<_>>()?;
            (found.len() == frames.len()).then_some(found)
        };
        let found: Vec<BTreeMap<String, PathBuf>> = cameras.iter().map(keys).collect::<Option<_>>()?;
        // Every camera must share a moment with another one.
        let joined = |i: usize| found[i].keys().any(|k| found.iter().filter(|of| of.contains_key(k)).count() > 1);
        if !(0..found.len()).all(joined) {
            return None;
        }
        let mut seen = std::collections::BTreeSet::new();
        let order = cameras.iter().flatten().filter_map(|frame| key(frame)).filter(|k| seen.insert(k.clone()));
        Some(order.map(|k| found.iter().map(|of| of.get(&k).cloned()).collect()).collect())
    };
    let (Some(first), Some(second)) = (cameras.first(), cameras.get(1)) else {
        return Err(Failure::usage("frames of two or more cameras are needed"));
    };
    let joined = match by {
        Some(PairBy::Order) => {
            // All cameras must have the same number of frames.
            for other in &cameras[1..] {
                in_order(first, other)?;
            }
            let moment = |i: usize| cameras.iter().map(|of| of.get(i).cloned()).collect();
            return Ok((0..first.len()).map(moment).collect());
        }
        Some(PairBy::Name) => shared(&name),
        Some(PairBy::Number) => shared(&number),
        None => shared(&name).or_else(|| shared(&number)),
    };
    // The error of two cameras that cannot be paired is the most specific one.
    joined.ok_or_else(|| {
        let others = cameras[1..].iter().find_map(|other| pair(first, other, by).err());
        others
            .or_else(|| pair(first, second, by).err())
            .unwrap_or_else(|| Failure::new("no two cameras have a frame of the same moment"))
    })
}

fn in_order(lefts: &[PathBuf], rights: &[PathBuf]) -> Result<Vec<(PathBuf, PathBuf)>, Failure> {
    if lefts.len() != rights.len() {
        return Err(Failure::new(format!("{} left frames and {} right ones", lefts.len(), rights.len()))
            .advice("give as many of each"));
    }
    Ok(lefts.iter().cloned().zip(rights.iter().cloned()).collect())
}

fn name(frame: &Path) -> Option<String> {
    Some(frame.file_stem()?.to_string_lossy().into_owned())
}

/// Returns the last number in the name, without leading zeros.
fn number(frame: &Path) -> Option<String> {
    let name = frame.file_stem()?.to_string_lossy().into_owned();
    let end = name.rfind(|c: char| c.is_ascii_digit())? + 1;
    let start = name[..end]
        .rfind(|c: char| !c.is_ascii_digit())
        .map_or(0, |at| at + name[at..].chars().next().map_or(1, char::len_utf8));
    let digits = name[start..end].trim_start_matches('0');
    Some(if digits.is_empty() { "0".to_owned() } else { digits.to_owned() })
}

fn by_key(
    lefts: &[PathBuf],
    rights: &[PathBuf],
    what: &str,
    key: impl Fn(&Path) -> Option<String>,
) -> Result<Vec<(PathBuf, PathBuf)>, Failure> {
    const ADVICE: &str = "select the frames of the same moments by patterns ('left/frame_00*.png'), or rename them; \
                          --pair-by order pairs them by position in the sorted list";
    let index = |frames: &[PathBuf]| -> Result<BTreeMap<String, PathBuf>, Failure> {
        let mut found: BTreeMap<String, PathBuf> = BTreeMap::new();
        for frame in frames {
            let Some(key) = key(frame) else {
                return Err(Failure::new(format!("there is no {what} in {}", frame.display())).advice(ADVICE));
            };
            if let Some(other) = found.insert(key, frame.clone()) {
                return Err(Failure::new(format!("{} and {} have the same {what}", other.display(), frame.display()))
                    .advice(ADVICE));
            }
        }
        Ok(found)
    };
    let (left, right) = (index(lefts)?, index(rights)?);
    let alone = |ours: &BTreeMap<String, PathBuf>, others: &BTreeMap<String, PathBuf>| {
        ours.iter().filter(|(key, _)| !others.contains_key(*key)).map(|(_, frame)| frame.clone()).collect::<Vec<_>>()
    };
    let (left_alone, right_alone) = (alone(&left, &right), alone(&right, &left));
    if left_alone.is_empty() && right_alone.is_empty() {
        // In the order of the left frames; the keys are sorted as text, not as numbers.
        let partner = |frame: &PathBuf| Some((frame.clone(), right.get(&key(frame)?)?.clone()));
        return Ok(lefts.iter().filter_map(partner).collect());
    }
    let list = |side: &str, alone: &[PathBuf]| match alone {
        [] => None,
        [one] => Some(format!("{} has no {side} frame of the same {what}", one.display())),
        [first, .., last] => Some(format!(
            "{} left without a {side} frame of the same {what}: {} to {}",
            alone.len(),
            first.display(),
            last.display()
        )),
    };
    let reasons: Vec<String> = [list("right", &left_alone), list("left", &right_alone)].into_iter().flatten().collect();
    Err(Failure::new(format!("{} left and {} right frames: {}", lefts.len(), rights.len(), reasons.join("; ")))
        .advice(ADVICE))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn paths(names: &[&str]) -> Vec<PathBuf> {
        names.iter().map(PathBuf::from).collect()
    }

    fn paired(left: &[&str], right: &[&str], by: Option<PairBy>) -> Result<Vec<(String, String)>, String> {
        let text = |path: PathBuf| path.display().to_string();
        pair(&paths(left), &paths(right), by)
            .map(|pairs| pairs.into_iter().map(|(a, b)| (text(a), text(b))).collect())
            .map_err(|failure| failure.text())
    }

    #[test]
    fn simultaneous_frames_are_paired() {
        let pairs = |list: &[(&str, &str)]| list.iter().map(|(a, b)| ((*a).into(), (*b).into())).collect::<Vec<_>>();
        let same = paired(&["l/f2.png", "l/f10.png"], &["r/f10.jpg", "r/f2.jpg"], None).unwrap();
        assert_eq!(same, pairs(&[("l/f2.png", "r/f2.jpg"), ("l/f10.png", "r/f10.jpg")]));
        // The names tell the side, the numbers the moment; leading zeros do not matter.
        let numbered = paired(&["left_0009.png", "left_0010.png"], &["right_9.png", "right_10.png"], None).unwrap();
        assert_eq!(numbered, pairs(&[("left_0009.png", "right_9.png"), ("left_0010.png", "right_10.png")]));
        // KITTI's names end in the same number everywhere.
        let kitti = paired(&["l/000001_10.png", "l/000002_10.png"], &["r/000001_10.png", "r/000002_10.png"], None);
        assert_eq!(kitti.unwrap().len(), 2);
        assert_eq!(paired(&["é0.png"], &["ü00.png"], None).unwrap().len(), 1);
        let ordered = paired(&["a.png", "b.png"], &["x.png", "y.png"], Some(PairBy::Order)).unwrap();
        assert_eq!(ordered, pairs(&[("a.png", "x.png"), ("b.png", "y.png")]));
    }

    #[test]
    fn unpaired_frames_can_be_kept() {
        let joined = |left: &[&str], right: &[&str], by| {
            let text = |path: Option<PathBuf>| path.map(|p| p.display().to_string()).unwrap_or_default();
            let found = join(&[paths(left), paths(right)], by);
            let both = |all: Moment| (text(all[0].clone()), text(all[1].clone()));
            found.map(|all| all.into_iter().map(both).collect::<Vec<_>>()).map_err(|f| f.text())
        };
        let own = |list: &[(&str, &str)]| {
            list.iter().map(|(a, b)| ((*a).into(), (*b).into())).collect::<Vec<(String, String)>>()
        };
        let some = joined(&["left1.png", "left3.png"], &["right2.png", "right3.png"], None).unwrap();
        assert_eq!(some, own(&[("left1.png", ""), ("left3.png", "right3.png"), ("", "right2.png")]));
        assert_eq!(joined(&["l/a.png"], &["r/a.png"], None).unwrap(), own(&[("l/a.png", "r/a.png")]));
        assert!(joined(&["left1.png"], &["right2.png"], None).unwrap_err().contains("left1.png"));
        assert!(joined(&["a1.png", "b1.png"], &["c1.png"], None).is_err());
    }

    #[test]
    fn frames_of_three_cameras_are_grouped_by_moment() {
        let frames = [paths(&["a/1.png", "a/2.png"]), paths(&["b/2.png", "b/3.png"]), paths(&["c/3.png", "c/1.png"])];
        let found = join(&frames, None).unwrap();
        let seen: Vec<Vec<bool>> = found.iter().map(|moment| moment.iter().map(Option::is_some).collect()).collect();
        assert_eq!(seen, [[true, false, true], [true, true, false], [false, true, true]]);
        assert_eq!(found[2][2].as_deref(), Some(Path::new("c/3.png")));
        // The third shares nothing with anyone.
        let alone = join(&[frames[0].clone(), frames[0].clone(), paths(&["c/9.png"])], None);
        assert!(alone.unwrap_err().text().contains("c/9.png"));
        assert!(
            join(&[paths(&["1.png"]), paths(&["x.png"]), paths(&["y.png", "z.png"])], Some(PairBy::Order)).is_err()
        );
        assert!(join(&frames[..1], None).is_err());
    }

    #[test]
    fn unpaired_frames_are_refused_by_name() {
        let (left, right) = (["l/f1.png", "l/f2.png", "l/f3.png"], ["r/f2.png", "r/f3.png", "r/f4.png"]);
        for by in [None, Some(PairBy::Name), Some(PairBy::Number)] {
            let text = paired(&left, &right, by).unwrap_err();
            assert!(["l/f1.png", "r/f4.png", "--pair-by order"].iter().all(|part| text.contains(part)), "{text}");
        }
        assert!(paired(&["a1.png", "b1.png"], &["c1.png", "d1.png"], None).unwrap_err().contains("same number"));
        assert!(paired(&["a.png"], &["b.png"], None).unwrap_err().contains("same name"));
        assert!(paired(&["a.png"], &["b.png"], Some(PairBy::Number)).unwrap_err().contains("no number"));
        assert!(paired(&["a.png"], &["b.png", "c.png"], Some(PairBy::Order)).is_err());
    }
}
