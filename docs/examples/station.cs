// A capture station in C#: every scan that the scanner saves is sent, checked, and judged in a line.
//
//     csc station.cs -r:System.Net.Http.dll -r:System.Runtime.Serialization.dll -r:System.Xml.Linq.dll
//     set MYOFACE_API_KEY=myo_...
//     station.exe C:\scans https://faces.example.com
//
// It needs nothing but what Windows has: its own compiler (C# 5, in Microsoft.NET\Framework64\v4.0.30319)
// makes it, and so does .NET 8. Each folder in C:\scans is a person, each OBJ, PLY, GLB or STL in it a raw
// scan, named like its file; one with neutral, neutre, rest or relaxed as a word of its name is the
// neutral. Scan again into the same file, and the new one takes the old one's place. With --once it looks once, and ends;
// the scans' unit is --unit cm (mm, cm, m, inch, foot, or how many mm it has), or --eye-distance 62, in mm.
using System;
using System.Collections.Generic;
using System.Globalization;
using System.IO;
using System.Linq;
using System.Net.Http;
using System.Net.Http.Headers;
using System.Runtime.Serialization.Json;
using System.Security.Cryptography;
using System.Text;
using System.Text.RegularExpressions;
using System.Threading;
using System.Xml;
using System.Xml.Linq;

static class Station {
    static readonly HttpClient Http = new HttpClient { Timeout = TimeSpan.FromMinutes(10) };
    static readonly Dictionary<string, DateTime> Done = new Dictionary<string, DateTime>();

    // Letters that are none with an accent
    static readonly Dictionary<char, string> Letters = new Dictionary<char, string> {
        { '\u00df', "ss" }, { '\u00e6', "ae" }, { '\u00c6', "AE" }, { '\u0153', "oe" }, { '\u0152', "OE" },
        { '\u00f8', "o" }, { '\u00d8', "O" }, { '\u0142', "l" }, { '\u0141', "L" } };

    static string Options = "{}"; // of the checks, as JSON

    static void Main(string[] given) {
        var words = given.Where((word, i) => !word.StartsWith("--") && (i == 0 || given[i - 1] != "--unit" && given[i - 1] != "--eye-distance")).ToArray();
        Http.BaseAddress = new Uri(words.Length > 1 ? words[1] : "http://127.0.0.1:8765");
        var unit = After(given, "--unit");
        var eyes = After(given, "--eye-distance");
        if (unit != null) Options = "{\"unit\":" + NumberOrText(unit) + "}";
        else if (eyes != null) Options = "{\"eye_distance_mm\":" + NumberOrText(eyes) + "}";
        var key = Environment.GetEnvironmentVariable("MYOFACE_API_KEY");
        Http.DefaultRequestHeaders.Authorization = new AuthenticationHeaderValue("Bearer", key);
        do {
            foreach (var path in Directory.GetFiles(words[0], "*.*", SearchOption.AllDirectories).Where(IsScan).OrderBy(p => !IsNeutral(p))) {
                var saved = File.GetLastWriteTimeUtc(path);
                if (Done.ContainsKey(path) && Done[path] == saved || DateTime.UtcNow - saved < TimeSpan.FromSeconds(2)) continue;
                try { DealWith(path); }
                catch (Refusal refusal) { Console.WriteLine("{0}: refused: {1}", path, refusal.Message); }
                catch (Exception fault) { Console.WriteLine("{0}: waits: {1}", path, fault.GetBaseException().Message); continue; }
                Done[path] = saved;
            }
            Thread.Sleep(1000);
        } while (!given.Contains("--once"));
    }

    static string After(string[] given, string option) { return given.SkipWhile(word => word != option).Skip(1).FirstOrDefault(); }

    static string NumberOrText(string word) {
        double number;
        var isNumber = double.TryParse(word, NumberStyles.Float, CultureInfo.InvariantCulture, out number);
        return isNumber ? number.ToString("R", CultureInfo.InvariantCulture) : Quote(word);
    }

    static void DealWith(string path) {
        var name = NameOf(path);
        RequireAlone(path, name);
        var sha256 = BitConverter.ToString(SHA256.Create().ComputeHash(File.ReadAllBytes(path))).Replace("-", "").ToLower();
        var captures = "/v1/subjects/" + SubjectOf(Path.GetDirectoryName(path)) + "/captures";
        var known = Ask("GET", captures + "?limit=1000").Element("items").Elements().FirstOrDefault(each => each.Element("name").Value == name);
        if (known == null || known.Element("sha256").Value != sha256)
            known = Ask("POST", captures, Json("name", name, "role", IsNeutral(path) ? "neutral" : "expression",
                "upload_id", Upload(path, sha256), "replaces", known == null ? null : known.Element("id").Value));
        var url = "/v1/jobs/" + Guid.NewGuid(); // our own id: sent twice, it is still one job
        var check = Ask("PUT", url, "{\"kind\":\"check_scan\",\"subject_id\":" + Quote(known.Element("subject_id").Value)
            + ",\"captures\":[" + Quote(known.Element("id").Value) + "],\"options\":" + Options + "}");
        while (!new[] { "succeeded", "failed", "canceled" }.Contains(check.Element("state").Value)) {
            Thread.Sleep(500);
            check = Ask("GET", url);
        }
        if (check.Element("state").Value != "succeeded") throw new Refusal("the check has " + check.Element("state").Value);
        var found = check.Element("result").Element("summary");
        Console.WriteLine("{0}: {1}", path, found.Element("verdict").Value);
        foreach (var finding in found.Element("findings").Elements())
            Console.WriteLine("    {0}: {1}", finding.Element("message").Value, finding.Element("advice").Value);
    }

    // Sends a file; where the line breaks, it goes on with what the service lacks.
    static string Upload(string path, string sha256) {
        var size = new FileInfo(path).Length;
        var start = new HttpRequestMessage(HttpMethod.Post, "/v1/uploads");
        start.Headers.Add("Upload-Length", size.ToString());
        start.Headers.Add("Upload-Metadata", "filename " + Base64(Path.GetFileName(path)) + ",sha256 " + Base64(sha256));
        var id = Send(start).Element("id").Value;
        for (long offset = 0, tries = 0; offset < size || tries == 0; tries++) {
            try {
                using (var stream = File.OpenRead(path)) {
                    stream.Seek(offset, SeekOrigin.Begin);
                    var part = new HttpRequestMessage(new HttpMethod("PATCH"), "/v1/uploads/" + id) { Content = new StreamContent(stream) };
                    part.Headers.Add("Upload-Offset", offset.ToString());
                    part.Content.Headers.ContentType = new MediaTypeHeaderValue("application/offset+octet-stream");
                    Send(part);
                }
            } catch (HttpRequestException) { if (tries > 20) throw; Thread.Sleep(2000); }
            offset = long.Parse(Ask("GET", "/v1/uploads/" + id).Element("offset").Value);
        }
        return id;
    }

    static string SubjectOf(string folder) {
        var note = Path.Combine(folder, ".myoface-subject");
        if (!File.Exists(note)) File.WriteAllText(note, Ask("POST", "/v1/subjects", Json("name", Path.GetFileName(folder))).Element("id").Value);
        return File.ReadAllText(note).Trim();
    }

    static bool IsScan(string path) { return Regex.IsMatch(path, @"\.(obj|ply|glb|stl)$", RegexOptions.IgnoreCase); }

    static bool IsNeutral(string path) { return Regex.IsMatch(Regex.Replace(Path.GetFileNameWithoutExtension(path), "([a-z])([A-Z])", "$1 $2"), "(?<![A-Za-z])(neutral|neutre|rest|relaxed)(?![A-Za-z])", RegexOptions.IgnoreCase); }

    // A legal name, as the client makes it (myoface/names.py): accents go, what is no letter, digit, _, - or .
    // becomes _, and 64 characters stay. Windows has devices (nul, com1) that no file can be called like.
    static string NameOf(string path) {
        var stem = Path.GetFileNameWithoutExtension(path);
        var name = stem;
        if (!Regex.IsMatch(stem, @"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}\z") || stem.EndsWith(".")) {
            var letters = string.Concat(stem.Select(c => Letters.ContainsKey(c) ? Letters[c] : c.ToString()));
            var plain = Regex.Replace(letters.Normalize(NormalizationForm.FormKD), "[\u0300-\u036f]", "");
            name = Regex.Replace(Regex.Replace(plain, "[^A-Za-z0-9_.-]+", "_"), @"^[^A-Za-z0-9]+|[^A-Za-z0-9]+\z", "");
            name = name.Substring(0, Math.Min(64, name.Length)).TrimEnd('.');
        }
        if (IsDevice(stem) || IsDevice(name)) throw new Refusal("this is a device's name on Windows, and no file's: rename it");
        if (name == "") throw new Refusal("no name can be made of it: a letter of a to z or a digit is needed");
        return name;
    }

    static bool IsDevice(string name) { return Regex.IsMatch(name, @"^(con|prn|aux|nul|(com|lpt)[0-9])(\.|\z)", RegexOptions.IgnoreCase); }

    // Refuses a file that another one of the person's would take the place of: case and a last dot tell no two apart.
    static void RequireAlone(string path, string name) {
        foreach (var other in Directory.GetFiles(Path.GetDirectoryName(path)).Where(IsScan).Where(p => p != path)) {
            string its;
            try { its = NameOf(other); } catch (Refusal) { continue; }
            if (string.Equals(its, name, StringComparison.OrdinalIgnoreCase))
                throw new Refusal("it and " + Path.GetFileName(other) + " would both be called " + name + ": rename one");
        }
    }

    static XElement Ask(string method, string path, string body = null) {
        var request = new HttpRequestMessage(new HttpMethod(method), path);
        if (body != null) request.Content = new StringContent(body, Encoding.UTF8, "application/json");
        return Send(request);
    }

    // Returns the answer's JSON as elements; what the service refuses, but for "later", is a Refusal.
    static XElement Send(HttpRequestMessage request) {
        var answer = Http.SendAsync(request).GetAwaiter().GetResult();
        var text = answer.Content.ReadAsByteArrayAsync().GetAwaiter().GetResult();
        if (answer.IsSuccessStatusCode && text.Length == 0) return null;
        if (text.Length == 0 || text[0] != '{') throw new HttpRequestException("the service answered " + (int)answer.StatusCode);
        var json = XElement.Load(JsonReaderWriterFactory.CreateJsonReader(text, XmlDictionaryReaderQuotas.Max));
        if (answer.IsSuccessStatusCode) return json;
        var isForGood = new[] { 404, 409, 410, 413, 422 }.Contains((int)answer.StatusCode) && json.Element("code").Value != "subject.busy";
        if (isForGood) throw new Refusal(json.Element("detail").Value);
        throw new HttpRequestException(json.Element("detail").Value);
    }

    static string Json(params string[] pairs) {
        var members = Enumerable.Range(0, pairs.Length / 2).Where(i => pairs[2 * i + 1] != null);
        return "{" + string.Join(",", members.Select(i => Quote(pairs[2 * i]) + ":" + Quote(pairs[2 * i + 1]))) + "}";
    }

    static string Quote(string text) {
        var plain = text.Select(c => c < ' ' || c > '~' || c == '"' || c == '\\' ? "\\u" + ((int)c).ToString("x4", CultureInfo.InvariantCulture) : c.ToString());
        return '"' + string.Concat(plain) + '"';
    }

    static string Base64(string text) { return Convert.ToBase64String(Encoding.UTF8.GetBytes(text)); }

    class Refusal : Exception { public Refusal(string words) : base(words) { } }
}
