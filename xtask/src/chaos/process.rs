//! Calling the program, and a place to do it in.

use anyhow::{Context, Result, bail};
use std::ffi::OsString;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Processor time from which a call hangs: undisturbed ones take below two seconds
/// (studies/records/2026-11-27-reliability.md). Time on the clock states nothing on a machine that is shared.
const BUSY: f64 = 60.0;
/// A call that waits so long without using a processor hangs.
const IDLE: Duration = Duration::from_secs(60);
/// Time after which a call counts as hanging if the system does not report processor time.
const HANGS: Duration = Duration::from_secs(120);
/// Time between two readings of the processor time.
const READING: Duration = Duration::from_millis(500);
/// Ticks a second in which Linux counts processor time, on all of its architectures.
const TICKS: f64 = 100.0;
/// Time between two checks whether a call has ended.
const POLL: Duration = Duration::from_millis(2);
/// Threads of a call: the machine may be shared.
const THREADS: &str = "2";

/// How a call ended.
pub(crate) struct Ending {
    pub(crate) code: Option<i32>,
    /// Its stderr.
    pub(crate) said: String,
}

/// The program under test.
pub(crate) struct Program(pub(crate) PathBuf);

impl Program {
    fn command(&self, words: &[OsString], place: &Path, limit: Option<u64>) -> Command {
        let mut command = match limit {
            None => Command::new(&self.0),
            // A quota for every file, in kilobytes: what writes more gets an error, as on a full disk.
            Some(kilobytes) => {
                let mut shell = Command::new("bash");
                let text = format!("trap '' XFSZ; ulimit -f {kilobytes}; exec \"$@\"");
                shell.args(["-c", &text, "bash"]).arg(&self.0);
                shell
            }
        };
        command.args(words).args(["--quiet", "--threads", THREADS]).current_dir(place);
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped());
        command
    }

    /// Starts a call.
    pub(crate) fn start(&self, words: &[OsString], place: &Path, limit: Option<u64>) -> Result<Call> {
        let mut child = self.command(words, place, limit).spawn().context("the program cannot be started")?;
        let mut pipe = child.stderr.take().expect("it was requested");
        let said = std::thread::spawn(move || {
            let mut bytes = Vec::new();
            let _ = pipe.read_to_end(&mut bytes);
            String::from_utf8_lossy(&bytes).into_owned()
        });
        Ok(Call { child, said: Some(said), words: words.to_vec() })
    }

    /// A call to its end.
    pub(crate) fn run(&self, words: &[OsString], place: &Path, limit: Option<u64>) -> Result<Ending> {
        self.start(words, place, limit)?.end()
    }
}

/// A running call.
pub(crate) struct Call {
    child: Child,
    said: Option<std::thread::JoinHandle<String>>,
    words: Vec<OsString>,
}

impl Call {
    /// Waits so long, or until it ends. Returns whether it is still running.
    pub(crate) fn wait(&mut self, time: Duration) -> Result<bool> {
        let began = Instant::now();
        while began.elapsed() < time {
            if self.child.try_wait()?.is_some() {
                return Ok(false);
            }
            std::thread::sleep(POLL);
        }
        Ok(self.child.try_wait()?.is_none())
    }

    /// Processor time of the process and of those that it waited for, seconds; `None`: the system does not report it.
    fn seconds(&self) -> Option<f64> {
        processor_time(&std::fs::read_to_string(format!("/proc/{}/stat", self.child.id())).ok()?)
    }

    /// kill -9.
    pub(crate) fn kill(mut self) -> Result<()> {
        self.child.kill()?;
        self.child.wait()?;
        Ok(())
    }

    pub(crate) fn end(mut self) -> Result<Ending> {
        let (mut used, mut moved) = (self.seconds(), Instant::now());
        while self.wait(READING)? {
            let now = self.seconds();
            if now > used {
                (used, moved) = (now, Instant::now());
            }
            let idle = if used.is_some() { IDLE } else { HANGS };
            if used.is_some_and(|s| s > BUSY) || moved.elapsed() > idle {
                let _ = self.child.kill();
                bail!("it hangs after {:.1} s of processor time: {:?}", used.unwrap_or_default(), self.words);
            }
        }
        let code = self.child.wait()?.code();
        let said = self.said.take().and_then(|s| s.join().ok()).unwrap_or_default();
        Ok(Ending { code, said })
    }
}

impl Drop for Call {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Seconds of a line of `/proc/PID/stat`: user and system time, own and of children.
fn processor_time(stat: &str) -> Option<f64> {
    // The name in parentheses may hold anything; the numbers behind it begin with the third, the state.
    let numbers: Vec<&str> = stat.rsplit_once(')')?.1.split_ascii_whitespace().collect();
    let ticks: Option<Vec<f64>> = numbers.get(11..15)?.iter().map(|n| n.parse().ok()).collect();
    Some(ticks?.iter().sum::<f64>() / TICKS)
}

/// A folder of this process that is deleted at the end.
pub(crate) struct Scratch(PathBuf);

impl Scratch {
    pub(crate) fn new() -> Result<Self> {
        let path = std::env::temp_dir().join(format!("splat4d-chaos-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&path);
        std::fs::create_dir_all(&path).with_context(|| path.display().to_string())?;
        Ok(Self(path.canonicalize()?))
    }

    pub(crate) fn path(&self) -> &Path {
        &self.0
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn processor_time_is_that_of_the_process_and_its_children() {
        let stat = "7 (a) b) R 1 7 7 0 -1 4194304 100 0 0 0 150 50 20 30 20 0 1 0 100 1000 10";
        assert_eq!(processor_time(stat), Some(2.5));
        assert_eq!(processor_time("7 (a) R 1"), None);
        #[cfg(target_os = "linux")]
        assert!(processor_time(&std::fs::read_to_string("/proc/self/stat").unwrap()).is_some());
    }

    #[test]
    #[cfg(target_os = "linux")]
    fn the_exit_status_of_a_process_is_reported() {
        let ended = Program("/bin/false".into()).run(&[], Path::new("."), None).unwrap();
        assert_eq!(ended.code, Some(1));
    }
}
