//! Files of `torch.save` (PyTorch 1.6 and later), read without running anything: a zip with a pickle that names
//! tensors, and a file for each storage of numbers.
//!
//! The interpreter of the pickle supports the operations of plain data and four callables ([`CALLABLES`]). Whatever
//! else it names becomes [`Value::Opaque`], is never looked up and never called. Objects are made once by the operation
//! that pushes them, so that their number is bounded by the bytes of the pickle.
//! Sources: Python's `pickletools` documentation (operations), PyTorch documentation, "Serialization semantics".

use super::bytes::Cursor;
use super::half::f16_to_f32;
use super::zip::Archive;
use crate::{Error, ErrorKind, Result};
use std::collections::HashMap;

/// The pickle of an archive, below its folder.
const PICKLE: &str = "data.pkl";
/// Longest pickle that is read: names and shapes alone; a network of a million tensors has less.
const MOST_PICKLE: usize = 64 << 20;
/// Most axes of a tensor that is accepted.
const MOST_AXES: usize = 16;

/// Functions that a pickle may call. All of them make plain data.
const CALLABLES: [&str; 4] = [
    "torch._utils _rebuild_tensor_v2",
    "torch._utils _rebuild_parameter",
    "torch._tensor _rebuild_from_type_v2",
    "collections OrderedDict",
];

/// A position in the list of objects.
type Id = usize;

/// An object of a pickle.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Value {
    None,
    Bool(bool),
    Int(i64),
    Float(f64),
    Text(String),
    /// A list or a tuple.
    List(Vec<Id>),
    Dict(Vec<(Id, Id)>),
    /// A class or a function by module and name.
    Global(String),
    Storage {
        kind: Kind,
        key: String,
        numbers: usize,
    },
    Tensor(Tensor),
    /// Something that is not plain data, and was not made.
    Opaque,
}

/// Type of the numbers of a storage.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    F64,
    F32,
    F16,
    Bf16,
    I64,
    I32,
    I16,
    U8,
}

impl Kind {
    /// By the name of the storage's class.
    fn of(class: &str) -> Option<Self> {
        Some(match class.rsplit(' ').next()? {
            "DoubleStorage" => Self::F64,
            "FloatStorage" => Self::F32,
            "HalfStorage" => Self::F16,
            "BFloat16Storage" => Self::Bf16,
            "LongStorage" => Self::I64,
            "IntStorage" => Self::I32,
            "ShortStorage" => Self::I16,
            "ByteStorage" | "BoolStorage" => Self::U8,
            _ => return None,
        })
    }

    fn size(self) -> usize {
        match self {
            Self::F64 | Self::I64 => 8,
            Self::F32 | Self::I32 => 4,
            Self::F16 | Self::Bf16 | Self::I16 => 2,
            Self::U8 => 1,
        }
    }

    fn number(self, b: &[u8]) -> f32 {
        fn array<const N: usize>(b: &[u8]) -> [u8; N] {
            *b.first_chunk().expect("a number has that many bytes")
        }
        match self {
            Self::F64 => f64::from_le_bytes(array(b)) as f32,
            Self::F32 => f32::from_le_bytes(array(b)),
            Self::F16 => f16_to_f32(u16::from_le_bytes(array(b))),
            Self::Bf16 => f32::from_bits(u32::from(u16::from_le_bytes(array(b))) << 16),
            Self::I64 => i64::from_le_bytes(array(b)) as f32,
            Self::I32 => i32::from_le_bytes(array(b)) as f32,
            Self::I16 => i16::from_le_bytes(array(b)).into(),
            Self::U8 => b[0].into(),
        }
    }
}

/// A tensor: a view of a storage.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Tensor {
    kind: Kind,
    key: String,
    offset: usize,
    pub(super) shape: Vec<usize>,
    strides: Vec<usize>,
}

/// The objects of a file.
pub(super) struct Torch<'a> {
    archive: Archive<'a>,
    folder: String,
    objects: Vec<Value>,
    root: Id,
}

/// Whether an archive is a file of `torch.save`: its pickle's name.
fn pickle_of(archive: &Archive<'_>) -> Option<String> {
    archive.names().into_iter().find(|n| n.strip_suffix(PICKLE).is_some_and(|folder| folder.ends_with('/')))
}

/// Whether bytes are a file of `torch.save`.
pub(super) fn is_torch(bytes: &[u8]) -> bool {
    bytes.starts_with(&super::zip::MAGIC) && Archive::open(bytes).is_ok_and(|a| pickle_of(&a).is_some())
}

impl<'a> Torch<'a> {
    /// Reads the pickle. Errors: damaged, or operations that plain data does not need.
    pub(super) fn open(bytes: &'a [u8]) -> Result<Self> {
        let archive = Archive::open(bytes)?;
        let name = pickle_of(&archive).ok_or_else(|| damaged("it has no data.pkl"))?;
        let folder = name.strip_suffix(PICKLE).expect("it ends so").to_owned();
        let pickle = archive.file(&name, MOST_PICKLE).expect("it is one of the names")?;
        let (objects, root) = Machine::run(&pickle)?;
        Ok(Self { archive, folder, objects, root })
    }

    /// The outermost object.
    pub(super) fn root(&self) -> &Value {
        &self.objects[self.root]
    }

    /// The entry of a dictionary with this name.
    pub(super) fn get(&self, dict: &Value, key: &str) -> Option<&Value> {
        let Value::Dict(entries) = dict else { return None };
        // Later entries replace earlier ones.
        let is = |id: &Id| matches!(&self.objects[*id], Value::Text(text) if text == key);
        entries.iter().rev().find(|(k, _)| is(k)).map(|(_, v)| &self.objects[*v])
    }

    /// Names of a dictionary's entries.
    pub(super) fn keys<'b>(&'b self, dict: &'b Value) -> Vec<&'b str> {
        let Value::Dict(entries) = dict else { return Vec::new() };
        let text = |(k, _): &(Id, Id)| match &self.objects[*k] {
            Value::Text(text) => Some(text.as_str()),
            _ => None,
        };
        entries.iter().filter_map(text).collect()
    }

    /// The items of a list or tuple; none of anything else.
    pub(super) fn items<'b>(&'b self, list: &'b Value) -> Vec<&'b Value> {
        let Value::List(items) = list else { return Vec::new() };
        items.iter().map(|id| &self.objects[*id]).collect()
    }

    /// The numbers of a tensor, row-major. Errors: it is outside its storage, which is missing or too short.
    pub(super) fn numbers(&self, tensor: &Tensor) -> Result<Vec<f32>> {
        let name = format!("{}data/{}", self.folder, tensor.key);
        // Storages are stored uncompressed: a small file cannot become a large one.
        let most = self.archive.packed(&name).unwrap_or(0);
        let file = self.archive.file(&name, most).ok_or_else(|| damaged(format!("{name} is missing")))?;
        let (bytes, size) = (file?, tensor.kind.size());
        let have = bytes.len() / size;
        let outside = || damaged(format!("a tensor of shape {:?} lies outside {name}", tensor.shape));
        let count = tensor.shape.iter().try_fold(1usize, |n, d| n.checked_mul(*d)).filter(|n| *n <= have);
        let count = count.ok_or_else(outside)?;
        if count == 0 {
            return Ok(Vec::new());
        }
        let reach = tensor.shape.iter().zip(&tensor.strides);
        let last = reach.into_iter().try_fold(tensor.offset, |at, (d, s)| at.checked_add((d - 1).checked_mul(*s)?));
        if last.is_none_or(|last| last >= have) {
            return Err(outside());
        }
        let mut out = Vec::with_capacity(count);
        let mut place = vec![0; tensor.shape.len()];
        for _ in 0..count {
            let at = place.iter().zip(&tensor.strides).map(|(i, s)| i * s).sum::<usize>() + tensor.offset;
            out.push(tensor.kind.number(&bytes[at * size..(at + 1) * size]));
            for axis in (0..place.len()).rev() {
                place[axis] += 1;
                if place[axis] < tensor.shape[axis] {
                    break;
                }
                place[axis] = 0;
            }
        }
        Ok(out)
    }
}

/// Reads a pickle.
struct Machine<'a> {
    input: Cursor<'a>,
    objects: Vec<Value>,
    stack: Vec<Id>,
    marks: Vec<usize>,
    memo: HashMap<u64, Id>,
}

impl<'a> Machine<'a> {
    /// The objects and the last of them.
    fn run(pickle: &'a [u8]) -> Result<(Vec<Value>, Id)> {
        let input = Cursor::new(pickle, "pickle");
        let mut machine =
            Self { input, objects: Vec::new(), stack: Vec::new(), marks: Vec::new(), memo: HashMap::new() };
        loop {
            let operation = machine.input.u8()?;
            if operation == b'.' {
                let root = machine.pop()?;
                return Ok((machine.objects, root));
            }
            machine.step(operation)?;
        }
    }

    fn push(&mut self, value: Value) {
        self.objects.push(value);
        self.stack.push(self.objects.len() - 1);
    }

    fn pop(&mut self) -> Result<Id> {
        let least = self.marks.last().copied().unwrap_or(0);
        if self.stack.len() <= least {
            return Err(damaged("its pickle takes more than it has"));
        }
        Ok(self.stack.pop().expect("it is not empty"))
    }

    /// Everything above the last mark.
    fn above(&mut self) -> Result<Vec<Id>> {
        let mark = self.marks.pop().ok_or_else(|| damaged("its pickle has no mark"))?;
        Ok(self.stack.split_off(mark.min(self.stack.len())))
    }

    fn top(&self) -> Result<Id> {
        self.stack.last().copied().ok_or_else(|| damaged("its pickle is empty"))
    }

    fn text(&mut self, length: usize) -> Result<String> {
        Ok(String::from_utf8_lossy(self.input.take(length)?).into_owned())
    }

    /// A line, without its end.
    fn line(&mut self) -> Result<String> {
        let mut line = Vec::new();
        loop {
            match self.input.u8()? {
                b'\n' => return Ok(String::from_utf8_lossy(&line).into_owned()),
                b => line.push(b),
            }
        }
    }

    fn words(&self, id: Id) -> Result<&str> {
        match &self.objects[id] {
            Value::Text(text) => Ok(text),
            _ => Err(damaged("its pickle has a name that is not text")),
        }
    }

    fn extend(&mut self, items: Vec<Id>) -> Result<()> {
        let top = self.top()?;
        if let Value::List(list) = &mut self.objects[top] {
            list.extend(items);
        }
        Ok(())
    }

    fn set(&mut self, items: &[Id]) -> Result<()> {
        let top = self.top()?;
        if let Value::Dict(entries) = &mut self.objects[top] {
            entries.extend(items.chunks_exact(2).map(|pair| (pair[0], pair[1])));
        }
        Ok(())
    }

    fn step(&mut self, operation: u8) -> Result<()> {
        match operation {
            // Protocol, frame.
            0x80 => drop(self.input.u8()?),
            0x95 => drop(self.input.u64()?),
            b'(' => self.marks.push(self.stack.len()),
            b'0' => drop(self.pop()?),
            b'1' => drop(self.above()?),
            b'2' => {
                let top = self.top()?;
                self.stack.push(top);
            }
            b'N' => self.push(Value::None),
            0x88 | 0x89 => self.push(Value::Bool(operation == 0x88)),
            b'K' => {
                let x = self.input.u8()?;
                self.push(Value::Int(x.into()));
            }
            b'M' => {
                let x = self.input.u16()?;
                self.push(Value::Int(x.into()));
            }
            b'J' => {
                let x = self.input.u32()?;
                self.push(Value::Int((x as i32).into()));
            }
            0x8A => {
                let length = self.input.u8()?;
                let bytes = self.input.take(length.into())?;
                if bytes.len() > 8 {
                    return Err(damaged("its pickle has a number beyond 64 bits"));
                }
                let negative = bytes.last().is_some_and(|b| b & 0x80 != 0);
                let mut all = [if negative { u8::MAX } else { 0 }; 8];
                all[..bytes.len()].copy_from_slice(bytes);
                self.push(Value::Int(i64::from_le_bytes(all)));
            }
            b'G' => {
                let x = self.input.u64()?;
                self.push(Value::Float(f64::from_bits(x.swap_bytes())));
            }
            b'X' | b'T' | b'B' => {
                let length = self.input.u32()? as usize;
                let text = self.text(length)?;
                self.push(Value::Text(text));
            }
            0x8C | b'U' | b'C' => {
                let length = self.input.u8()?.into();
                let text = self.text(length)?;
                self.push(Value::Text(text));
            }
            0x8D | 0x8E => {
                let length = usize::try_from(self.input.u64()?).unwrap_or(usize::MAX);
                let text = self.text(length)?;
                self.push(Value::Text(text));
            }
            b']' | b')' | 0x8F => self.push(Value::List(Vec::new())),
            b'}' => self.push(Value::Dict(Vec::new())),
            b'l' | b't' | 0x91 => {
                let items = self.above()?;
                self.push(Value::List(items));
            }
            0x85..=0x87 => {
                let mut items = (0..operation - 0x84).map(|_| self.pop()).collect::<Result<Vec<_>>>()?;
                items.reverse();
                self.push(Value::List(items));
            }
            b'd' => {
                let items = self.above()?;
                self.push(Value::Dict(items.chunks_exact(2).map(|pair| (pair[0], pair[1])).collect()));
            }
            b'a' => {
                let item = self.pop()?;
                self.extend(vec![item])?;
            }
            b'e' | 0x90 => {
                let items = self.above()?;
                self.extend(items)?;
            }
            b's' => {
                let (value, key) = (self.pop()?, self.pop()?);
                self.set(&[key, value])?;
            }
            b'u' => {
                let items = self.above()?;
                self.set(&items)?;
            }
            b'q' => {
                let place = self.input.u8()?.into();
                let top = self.top()?;
                self.memo.insert(place, top);
            }
            b'r' => {
                let place = self.input.u32()?.into();
                let top = self.top()?;
                self.memo.insert(place, top);
            }
            0x94 => {
                let top = self.top()?;
                self.memo.insert(self.memo.len() as u64, top);
            }
            b'h' | b'j' => {
                let place = if operation == b'h' { self.input.u8()?.into() } else { self.input.u32()?.into() };
                let id = *self.memo.get(&place).ok_or_else(|| damaged("its pickle recalls what it never kept"))?;
                self.stack.push(id);
            }
            b'c' => {
                let (module, name) = (self.line()?, self.line()?);
                self.push(Value::Global(format!("{module} {name}")));
            }
            0x93 => {
                let (name, module) = (self.pop()?, self.pop()?);
                let global = format!("{} {}", self.words(module)?, self.words(name)?);
                self.push(Value::Global(global));
            }
            b'Q' => {
                let id = self.pop()?;
                let storage = self.storage(id)?;
                self.push(storage);
            }
            b'R' => {
                let (arguments, callable) = (self.pop()?, self.pop()?);
                let made = self.call(callable, arguments)?;
                self.push(made);
            }
            // State for an object: plain data is complete without it, and nothing else is built.
            b'b' => drop(self.pop()?),
            0x81 => {
                self.pop()?;
                self.pop()?;
                self.push(Value::Opaque);
            }
            0x92 => {
                for _ in 0..3 {
                    self.pop()?;
                }
                self.push(Value::Opaque);
            }
            other => {
                let what = format!("its pickle has the operation 0x{other:02X}, which plain data does not need");
                return Err(Error::new(ErrorKind::Unsupported, what).remedy("Export .ply from its program."));
            }
        }
        Ok(())
    }

    fn items(&self, id: Id) -> &[Id] {
        match &self.objects[id] {
            Value::List(items) => items,
            _ => &[],
        }
    }

    fn count(&self, id: Id) -> Option<usize> {
        match self.objects[id] {
            Value::Int(n) => usize::try_from(n).ok(),
            _ => None,
        }
    }

    fn counts(&self, id: Id) -> Option<Vec<usize>> {
        let items = self.items(id);
        if items.len() > MOST_AXES { None } else { items.iter().map(|i| self.count(*i)).collect() }
    }

    /// ("storage", class, key, position, numbers)
    fn storage(&self, id: Id) -> Result<Value> {
        let &[_, class, key, _, numbers] = self.items(id) else {
            return Err(damaged("its pickle refers to an object that is not a storage"));
        };
        let Value::Global(class) = &self.objects[class] else { return Ok(Value::Opaque) };
        let (Some(kind), Some(numbers)) = (Kind::of(class), self.count(numbers)) else { return Ok(Value::Opaque) };
        Ok(Value::Storage { kind, key: self.words(key)?.to_owned(), numbers })
    }

    /// The result of a callable of [`CALLABLES`]; anything else is refused.
    fn call(&self, callable: Id, arguments: Id) -> Result<Value> {
        let Value::Global(name) = &self.objects[callable] else { return Ok(Value::Opaque) };
        let arguments = self.items(arguments);
        let known = CALLABLES.iter().position(|c| c == name);
        Ok(match (known, arguments) {
            (Some(0), &[storage, offset, shape, strides, ..]) => {
                let Value::Storage { kind, key, .. } = &self.objects[storage] else { return Ok(Value::Opaque) };
                let bad = || damaged("its pickle has a tensor without a shape");
                let (shape, strides) = (self.counts(shape).ok_or_else(bad)?, self.counts(strides).ok_or_else(bad)?);
                let offset = self.count(offset).ok_or_else(bad)?;
                if shape.len() != strides.len() {
                    return Err(bad());
                }
                Value::Tensor(Tensor { kind: *kind, key: key.clone(), offset, shape, strides })
            }
            // A tensor in a wrapping.
            (Some(1), &[tensor, ..]) => self.plain(tensor),
            // (function, type, arguments, state): the tensor is made of the arguments.
            (Some(2), &[function, _, arguments, ..]) => self.call(function, arguments)?,
            (Some(3), &[]) => Value::Dict(Vec::new()),
            (Some(3), &[pairs]) => {
                let pair = |id: &Id| match self.items(*id) {
                    &[key, value] => Some((key, value)),
                    _ => None,
                };
                Value::Dict(self.items(pairs).iter().filter_map(pair).collect())
            }
            _ => Value::Opaque,
        })
    }

    /// A copy of a tensor; anything else is not copied.
    fn plain(&self, id: Id) -> Value {
        match &self.objects[id] {
            Value::Tensor(tensor) => Value::Tensor(tensor.clone()),
            _ => Value::Opaque,
        }
    }
}

fn damaged(what: impl std::fmt::Display) -> Error {
    Error::input(format!("this checkpoint of PyTorch is damaged: {what}")).remedy("Copy or save it again.")
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::format::mutate::mutants;
    use crate::format::zip;

    /// A file of `torch.save` of a dictionary of f32 tensors: name, shape and numbers. `inside`: a key that holds it.
    pub(in crate::format) fn saved(
        inside: Option<&str>,
        tensors: &[(&str, &[usize], Vec<f32>)],
        more: &[u8],
    ) -> Vec<u8> {
        let mut p = b"\x80\x02}(".to_vec();
        let text = |p: &mut Vec<u8>, s: &str| {
            p.push(b'X');
            p.extend((s.len() as u32).to_le_bytes());
            p.extend(s.as_bytes());
        };
        let int = |p: &mut Vec<u8>, n: usize| {
            p.push(b'J');
            p.extend((n as u32).to_le_bytes());
        };
        if let Some(key) = inside {
            text(&mut p, key);
            p.extend(b"ccollections\nOrderedDict\n)R(");
        }
        let mut files: Vec<(String, Vec<u8>)> = Vec::new();
        for (i, (name, shape, numbers)) in tensors.iter().enumerate() {
            text(&mut p, name);
            p.extend(b"ctorch._utils\n_rebuild_tensor_v2\n((");
            text(&mut p, "storage");
            p.extend(b"ctorch\nFloatStorage\n");
            text(&mut p, &i.to_string());
            text(&mut p, "cpu");
            int(&mut p, numbers.len());
            p.extend(b"tQ");
            int(&mut p, 0);
            p.push(b'(');
            shape.iter().for_each(|d| int(&mut p, *d));
            p.extend(b"t(");
            (0..shape.len()).for_each(|k| int(&mut p, shape[k + 1..].iter().product()));
            p.extend(b"t\x89ccollections\nOrderedDict\n)RtR");
            files.push((format!("archive/data/{i}"), numbers.iter().flat_map(|x| x.to_le_bytes()).collect()));
        }
        p.push(b'u');
        if inside.is_some() {
            p.extend(more);
            p.push(b'u');
        }
        p.push(b'.');
        files.insert(0, ("archive/data.pkl".into(), p));
        let all: Vec<(&str, &[u8])> = files.iter().map(|(n, b)| (n.as_str(), &b[..])).collect();
        let mut out = Vec::new();
        zip::write(&all, 64, &mut out).unwrap();
        out
    }

    #[test]
    fn tensors_are_read_by_name() {
        let numbers: Vec<f32> = (0..6).map(|i| i as f32).collect();
        let file = saved(Some("splats"), &[("means", &[2, 3], numbers.clone())], b"");
        assert!(is_torch(&file));
        let torch = Torch::open(&file).unwrap();
        let splats = torch.get(torch.root(), "splats").unwrap();
        assert_eq!(torch.keys(splats), ["means"]);
        let Some(Value::Tensor(means)) = torch.get(splats, "means") else { panic!("a tensor") };
        assert_eq!((&means.shape[..], torch.numbers(means).unwrap()), (&[2, 3][..], numbers));
        // Columns first.
        let turned = Tensor { shape: vec![3, 2], strides: vec![1, 3], ..means.clone() };
        assert_eq!(torch.numbers(&turned).unwrap(), [0.0, 3.0, 1.0, 4.0, 2.0, 5.0]);
        for (shape, strides, offset) in [([2, 4], [3, 1], 0), ([2, 3], [3, 1], 1), ([1 << 40, 1 << 40], [0, 0], 0)] {
            let lie = Tensor { shape: shape.into(), strides: strides.into(), offset, ..means.clone() };
            assert!(torch.numbers(&lie).unwrap_err().to_string().contains("outside"), "{shape:?}");
        }
    }

    #[test]
    fn nothing_is_ever_called() {
        // os.system("..."), as pickle.dumps writes it, and a subclass with a state.
        let call = b"X\x04\0\0\0evilcposix\nsystem\nX\x02\0\0\0ls\x85R";
        let torch = saved(Some("splats"), &[("means", &[1], vec![1.0])], call);
        let torch = Torch::open(&torch).unwrap();
        assert_eq!(torch.get(torch.root(), "evil"), Some(&Value::Opaque));
        let object = b"X\x04\0\0\0evilcargparse\nNamespace\n)\x81}b";
        let torch = saved(Some("splats"), &[("means", &[1], vec![1.0])], object);
        assert_eq!(Torch::open(&torch).unwrap().keys(Torch::open(&torch).unwrap().root()), ["splats", "evil"]);
        // Text operations of protocol 0 are not plain data of torch.
        let old = saved(Some("splats"), &[], b"X\x01\0\0\0aI12\n");
        assert!(Torch::open(&old).err().unwrap().to_string().contains("0x49"));
    }

    #[test]
    fn damaged_pickles_never_panic() {
        let file = saved(Some("splats"), &[("means", &[2, 3], vec![0.5; 6])], b"");
        let archive = Archive::open(&file).unwrap();
        let pickle = archive.file("archive/data.pkl", 1 << 20).unwrap().unwrap();
        for mutant in mutants(&pickle, 3000, "pickle") {
            let _ = Machine::run(&mutant);
        }
        for cut in 0..pickle.len() {
            assert!(Machine::run(&pickle[..cut]).is_err());
        }
    }
}
